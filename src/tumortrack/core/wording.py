"""Messages name options as the command line has them; whoever calls from Python reads keywords."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

_FLAGS = ("overwrite", "whole", "labels", "elastic", "scan", "squeeze", "uncalibrated", "tissue")
_OTHERS = {"checkpoint-every": "checkpoint_every_s"}
_VALUE = (  # in quotes, a number, in CAPITALS, or one of the few words that options have
    r"'[^']*'|-?(?:\d+(?:\.\d+)?(?:e-?\d+)?|nan|inf)\b|[A-Z][A-Z0-9]*\b"
    r"|(?:mm?|left|right)\b|[a-z]+_\w+|(?<=--name )(?!of\b)[a-z]+"
)
# Whole commands stay as they are.
_OPTION = re.compile(
    r"`[^`]*`|\b(?:tumortrack|pip) [a-z-]+ [^.;`]*"
    rf"|--(?P<name>[a-z](?:[a-z-]*[a-z])?)(?P<values>(?: (?:{_VALUE}))*)"
)
_on_command_line = False


@contextmanager
def command_line() -> Iterator[None]:
    """Within, messages stay as they are."""
    global _on_command_line
    before, _on_command_line = _on_command_line, True
    try:
        yield
    finally:
        _on_command_line = before


def for_caller(text: str) -> str:
    """A message with ``--an-option VALUE`` as ``an_option=VALUE``, unless a command says it."""
    return text if _on_command_line or "--" not in text else _OPTION.sub(_as_keyword, text)


def _as_keyword(found: re.Match[str]) -> str:
    if (option := found["name"]) is None:
        return found[0]
    given = re.findall(r"'[^']*'|\S+", found["values"])
    numbers = ("nan", "inf")
    values = [f'"{each}"' if each[0].islower() and each not in numbers else each for each in given]
    if not values and option in _FLAGS:
        values = ["True"]
    value = ", ".join(values)
    name = _OTHERS.get(option, option.replace("-", "_"))
    return f"{name}=({value})" if len(values) > 1 else f"{name}={value}"
