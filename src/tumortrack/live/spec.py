"""``kind:target?key=value&key=value`` -> the configuration of a source, sink, pose or tool.

A kind is a configuration class that an installed package, such as tumortrack-devices, offers by an
entry point in ``tumortrack.sources``, ``.sinks``, ``.poses`` or ``.tools``, named as the class's
``tag`` (``core/plugins.py``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Generic, TypeVar

import msgspec

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.core.plugins import Plugin, names, plugins
from tumortrack.core.renamed import hint
from tumortrack.core.report import Point
from tumortrack.live.poses import PosesConfig
from tumortrack.live.tools import ToolConfig
from tumortrack.live.values import SinkConfig, SourceConfig

C = TypeVar("C", bound=Config)


@dataclass(frozen=True)
class Registry(Generic[C]):
    """The kinds of one ``what``: those of the entry points' ``group``, of the class ``base``, and
    ``built_in`` ones (``module:class`` by kind). ``packages``: what to install for the kinds of our
    other distributions."""

    what: str
    group: str
    base: Any
    packages: Mapping[str, str] = field(default_factory=dict)
    built_in: Mapping[str, str] = field(default_factory=dict)

    def parse(self, text: str) -> C:
        """The configuration that ``text`` describes. Raises InputError for an unknown kind, key or
        value (listing what is allowed), and if a package is broken."""
        head, _, options = text.partition("?")
        kind, _, target = head.partition(":")
        where = f"{self.what} {text!r}"
        return _filled(self.config(kind, where), target, options, where)

    def config(self, kind: str, where: str) -> type[C]:
        """The configuration class of a kind. Raises InputError, which begins with ``where``."""
        if kind in self.built_in:
            return resolve_name(self.built_in[kind])
        if (found := next(plugins(self.group, self.base, name=kind), None)) is not None:
            if found.fault:
                raise InputError(f"{where}: {found.refusal}")
            return found.loaded
        if kind in self.packages:
            raise InputError(
                f"{where}: {kind!r} is not installed here: {to_install(self.packages[kind])}."
            )
        allowed = sorted({*self.built_in, *self.packages, *names(self.group)})
        raise InputError(f"{where}: there is no kind {kind!r}. Allowed: {', '.join(allowed)}.")


def _devices(*kinds: str, **others: str) -> dict[str, str]:
    return dict.fromkeys(kinds, "tumortrack-devices") | others


SOURCES = Registry[SourceConfig](
    "source",
    "sources",
    SourceConfig,
    _devices(
        *("virtual", "recording", "ros2"),
        realsense="tumortrack-devices[realsense]",
        stereo="tumortrack-devices[stereo]",
        rehearsal="tumortrack-benchmarks",
    ),
)
SINKS = Registry[SinkConfig](
    "sink",
    "sinks",
    SinkConfig,
    _devices(
        *("viewer", "recording", "ros2", "moveit", "openigtlink"),
        ur="tumortrack-resection[ur]",
        crtk="tumortrack-resection",
    ),
)
POSES = Registry[PosesConfig](
    "camera's pose",
    "poses",
    PosesConfig,
    _devices("ros2", "ur"),
    {"file": "tumortrack.live.poses:PosesFileConfig"},
)
TOOLS = Registry[ToolConfig](
    "tool", "tools", ToolConfig, _devices("file", "ros2", "openigtlink", "ur", "crtk")
)


def extensions() -> Iterator[Plugin]:
    """All kinds that installed packages add."""
    for kinds in (SOURCES, SINKS, POSES, TOOLS):
        yield from plugins(kinds.group, kinds.base, kinds.built_in)


def _filled(config: type[C], target: str, options: str, where: str) -> C:
    def refused(what: str) -> InputError:
        return InputError(f"{where}{what}. {usage(config)}")

    given: dict[str, str] = {}
    for option in filter(None, options.split("&")):
        key, _, value = option.partition("=")  # not unquoted: paths may contain + and %
        if key in given:
            raise refused(f": {key!r} is given twice")
        given[key] = value
    fields = {field.name: field for field in msgspec.structs.fields(config)}
    target_name = getattr(config, "target", "")
    if target and (not target_name or target_name in given):
        raise refused(f": {target!r} has no place there")
    if target:
        given[target_name] = target
    if unknown := [key for key in given if key not in fields]:
        said = hint("keys", f"{config.__name__}.{unknown[0]}")
        raise refused(f": {unknown[0]!r} is no option{said}")
    if missing := [n for n, f in fields.items() if f.required and n not in given]:
        raise refused(f" lacks its {missing[0]}")
    try:
        return config(**{key: _value(key, fields[key].type, text) for key, text in given.items()})
    except (TypeError, ValueError) as error:  # also of a foreign class's own check
        raise refused(f": {error}") from error


def _value(key: str, kind: Any, text: str) -> Any:
    words = text.split(",") if kind in (Point, Point | None) else text
    try:
        return msgspec.convert(words, kind, strict=False, dec_hook=_path)
    except msgspec.ValidationError as error:
        literals = getattr(msgspec.inspect.type_info(kind), "values", ())
        allowed = f"allowed: {', '.join(map(str, literals))}" if literals else error
        raise ValueError(f"{key} is {text!r}; {allowed}") from error


def _path(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"{kind.__name__} is not read from text")


def usage(config: type[Config]) -> str:
    """How to write a kind, with the defaults of its options."""
    kind, target = str(config.__struct_config__.tag), getattr(config, "target", "")
    fields = {field.name: field for field in msgspec.structs.fields(config)}
    first = fields.pop(target, None)
    options = "&".join(f"{name}={_text(field.default)}" for name, field in fields.items())
    place = "" if first is None else (f":{target.upper()}" if first.required else f"[:{target}]")
    return f"Write {kind}{place}" + (f"[?{options}]" if options else "") + "."


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ",".join(f"{number:g}" for number in value)
    return "" if value is None or value is msgspec.NODEFAULT else str(value)
