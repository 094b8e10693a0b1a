"""An attack: hostile input that is written into an empty folder, and a command on it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Room:
    """An empty folder, and the one with case, model, scenes, run and plan (``base_in``)."""

    folder: Path
    base: Path

    @property
    def out(self) -> Path:
        return self.folder / "out"

    @property
    def cloud(self) -> Path:
        """A right cloud of the model's organ."""
        return self.base / "scenes" / "0000" / "cloud.ply"

    def file(self, name: str, content: bytes) -> Path:
        (self.folder / name).write_bytes(content)
        return self.folder / name

    def fifo(self, name: str) -> Path:
        """A reader of it waits for good."""
        (self.folder / name).unlink(missing_ok=True)
        os.mkfifo(self.folder / name)
        return self.folder / name

    def endless(self, name: str) -> Path:
        (self.folder / name).unlink(missing_ok=True)
        (self.folder / name).symlink_to("/dev/zero")
        return self.folder / name


Make = Callable[[Room], list[object]]  # writes its files; returns the command's arguments


@dataclass(frozen=True)
class Attack:
    """``end``: refused in one line; read, since it is odd but right; or either, with a note or a
    verdict other than good."""

    make: Make
    end: Literal["refused", "either", "read"]


def attacks(
    refused: Mapping[str, Make], either: Mapping[str, Make] = {}, read: Mapping[str, Make] = {}
) -> dict[str, Attack]:
    return {
        **{name: Attack(make, "refused") for name, make in refused.items()},
        **{name: Attack(make, "either") for name, make in either.items()},
        **{name: Attack(make, "read") for name, make in read.items()},
    }
