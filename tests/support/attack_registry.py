"""An attack is a function that writes what it needs into an empty folder and returns the arguments
of a command. Its docstring says what is wrong with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

Made = list[object]
Attack = Callable[[Path, Path], Made]  # (empty folder, base: case, model, scenes, run, plan)
ATTACKS: dict[str, Attack] = {}
FINISH: set[str] = set()  # may also end well, with a note or a verdict other than good
MUST_FINISH: set[str] = set()  # odd, but right: to be read


def attack(make: Attack) -> Attack:
    ATTACKS[make.__name__.strip("_")] = make
    return make


def must_finish(make: Attack) -> Attack:
    MUST_FINISH.add(make.__name__.strip("_"))
    return may_finish(make)


def may_finish(make: Attack) -> Attack:
    FINISH.add(make.__name__.strip("_"))
    return attack(make)
