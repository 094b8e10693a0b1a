"""Hostile input: files written into an empty room, and a command on them that must end in one clear
line, in bounded time and memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import warm
from stories import environment

SECONDS, MEGABYTES = 20, 1024
CPU = ("--device", "cpu")
NAN = float("nan")


@dataclass(frozen=True)
class Room:
    """An empty folder, and the one with case, model, network, scenes, run and plan."""

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
        (self.folder / name).parent.mkdir(exist_ok=True)
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


def attacks(
    refused: Mapping[str, Make] = {},
    either: Mapping[str, Make] = {},
    read: Mapping[str, Make] = {},
    long: tuple[str, ...] = ("",),
) -> pytest.MarkDecorator:
    """A test's ``make`` and ``end``. ``read``: it is odd but right; ``either``: read, or refused.
    ``long``: how names begin of those that only `make attack` runs."""
    rows = [
        pytest.param(make, end, id=name, marks=[pytest.mark.attack] * name.startswith(long))
        for end, group in (("refused", refused), ("either", either), ("read", read))
        for name, make in group.items()
    ]
    return pytest.mark.parametrize(("make", "end"), rows)


def check(make: Make, end: str, room: Room) -> None:
    """The command ends as it must, and leaves nothing but a report of why."""
    words = list(map(os.fspath, map(_word, make(room))))
    before = _files_below(room.folder)
    allowed_s = SECONDS * (1 if end == "refused" else 6)  # what may end well does the whole work
    done = warm.run(words, environment(), 10 * allowed_s)
    output = done.stdout + done.stderr
    assert done.returncode >= 0, f"killed by signal {-done.returncode}: {output}"
    assert "Traceback" not in output
    assert "Warning: " not in output  # Python's, as NumPy gives
    assert done.cpu_s < allowed_s / 2
    assert done.megabytes < MEGABYTES
    if done.returncode == 0 or "\nwritten to" in output:  # with 4 where an estimate is poor
        assert end != "refused", output
        return
    assert end != "read", output
    assert done.returncode != 1, output
    refusals = [line for line in output.splitlines() if line.startswith("tumortrack: ")]
    assert len(refusals) == 1, output
    left = {path.name for path in _files_below(room.folder) - before}
    # why there is no estimate
    assert left <= {"report.json", "index.html", "picture.png", "manifest.json"}
    assert left <= {"report.json"} or "index.html" in left


def _word(word: object) -> Any:
    return word if isinstance(word, Path) else str(word)


def _files_below(folder: Path) -> set[Path]:
    return {Path(at, name) for at, _, names in os.walk(folder) for name in names}
