"""What is gone or has another name, said where the old name is used: renamed.toml has it all."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from tumortrack.core.tables import read_table

NOTHING = "nothing"  # replaces it, and after a colon why


@cache
def table() -> Mapping[str, Mapping[str, str]]:
    """renamed.toml: by its section, what replaces an old name, in Markdown."""
    return read_table("tumortrack.core", "renamed.toml", dict[str, dict[str, str]])


def hint(section: str, old: str) -> str:
    """What a message adds that names ``old``; empty: the table does not have it."""
    new = table()[section].get(old, "")
    nothing, _, why = new.partition(f"{NOTHING}: ")
    return new and (f"; use {new} instead" if nothing else f"; {why}")


def refuse_module(name: str) -> None:
    """Raises ModuleNotFoundError: a module of the table."""
    if said := hint("modules", name):
        raise ModuleNotFoundError(f"No module named {name!r}{said}", name=name)


def attributes_of(module: str) -> Callable[[str], Any]:
    """``__getattr__`` of a module. It raises AttributeError, which names what replaces the name."""

    def absent(name: str) -> Any:
        said = hint("names", f"{module}.{name}")
        raise AttributeError(f"module {module!r} has no attribute {name!r}{said}", name=name)

    return absent


class Renamed:
    """Base of values whose attributes had other names: the AttributeError says the new one."""

    __slots__ = ()
    if not TYPE_CHECKING:  # to a type checker what is not there stays so

        def __getattr__(self, name: str) -> Any:
            kind = type(self)
            if said := _hints(kind).get(name):
                what = f"{kind.__name__!r} object has no attribute {name!r}{said}"
                raise AttributeError(what, name=name, obj=self)
            return object.__getattribute__(self, name)  # raises what led here


@cache  # code asks values for what they may lack, in every frame
def _hints(kind: type) -> Mapping[str, str]:
    """By the old names of a class's attributes."""
    owners = {f"{each.__module__}.{each.__qualname__}" for each in kind.__mro__}
    split = ((old, *old.rpartition(".")[::2]) for old in table()["names"])
    return {name: hint("names", old) for old, owner, name in split if owner in owners}


def in_command(words: Sequence[str]) -> list[str]:
    """What is said of old names in a command that could not be parsed, a line each."""
    flat = [part for word in words for part in word.split("=", 1)]
    asked = [("commands", word) for word in flat[:1]]
    asked += [("options", f"{flat[0]} {word}") for word in flat[1:]]
    asked += [("choices", " ".join(pair)) for pair in pairwise(flat)]
    return [f"there is no {old}{said}." for section, old in asked if (said := hint(section, old))]


def in_report(content: object) -> list[str]:
    """Of a report.json: which keys it has by their old names, and their new ones."""
    return [f"{key}{hint('report', key)}" for key in table()["report"] if _has(content, key)]


def _has(content: object, key: str) -> bool:
    """Whether JSON has a key with dots; NAME: of any name, and in any member of a list."""
    if isinstance(content, list):
        return any(_has(each, key) for each in content)
    if not key or not isinstance(content, dict):
        return not key
    name, _, rest = key.partition(".")
    members = content.values() if name == "NAME" else [content[name]] if name in content else []
    return any(_has(each, rest) for each in members)


def of_unknown_key(kind: type, fault: str) -> str:
    """The hint for a key, or a kind, that msgspec does not know, by its message."""
    found = re.search(r"unknown field `(\w+)`|Invalid value '(\w+)'", fault)
    return hint("keys", f"{kind.__name__}.{found[1] or found[2]}") if found else ""
