"""``kind:target?key=value&key=value`` -> the configuration of a source or sink."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError

C = TypeVar("C", bound=Config)


def parse_spec(text: str, kinds: Sequence[type[C]], what: str) -> C:
    """One of ``kinds`` (each with a ``target``), its fields filled from text; ``what`` names it in
    errors.

    Raises:
        InputError: no such kind, key or value; the message lists what there is.
    """
    head, _, options = text.partition("?")
    kind, _, target = head.partition(":")
    by_name = {str(k.__struct_config__.tag): k for k in kinds}
    if kind not in by_name:
        raise InputError(f"{what} {text!r}: there is no kind {kind!r}. Allowed: {_all(by_name)}.")
    config = by_name[kind]
    given: dict[str, str] = {}
    for option in filter(None, options.split("&")):
        key, _, value = option.partition("=")  # as it is: paths may hold + and %
        if key in given:
            raise InputError(f"{what} {text!r}: {key!r} is given twice.")
        given[key] = value
    names = {field.name: field for field in msgspec.structs.fields(config)}
    target_name = getattr(config, "target", "")
    if target and (not target_name or target_name in given):
        raise InputError(f"{what} {text!r}: {target!r} has no place there. {usage(config)}")
    if target:
        given[target_name] = target
    if unknown := [key for key in given if key not in names]:
        raise InputError(f"{what} {text!r}: {unknown[0]!r} is no option. {usage(config)}")
    if missing := [n for n, f in names.items() if f.required and n not in given]:
        raise InputError(f"{what} {text!r} lacks its {missing[0]}. {usage(config)}")
    try:
        return msgspec.convert(given, config, strict=False, dec_hook=_path)
    except msgspec.ValidationError as error:
        raise InputError(f"{what} {text!r}: {error}. {usage(config)}") from error


def _path(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"{kind.__name__} is not read from text")


def usage(config: type[Config]) -> str:
    """How a kind is written, with its options' defaults."""
    kind, target = str(config.__struct_config__.tag), getattr(config, "target", "")
    fields = [f for f in msgspec.structs.fields(config) if f.name != target]
    options = "&".join(f"{f.name}={_text(f.default)}" for f in fields)
    first = next((f for f in msgspec.structs.fields(config) if f.name == target), None)
    place = "" if first is None else (f":{target.upper()}" if first.required else f"[:{target}]")
    return f"Write {kind}{place}" + (f"[?{options}]" if options else "") + "."


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None or value is msgspec.NODEFAULT else str(value)


def _all(by_name: dict[str, type[C]]) -> str:
    return ", ".join(sorted(by_name))
