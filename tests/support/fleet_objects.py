"""Small real tasks for the fleet: each takes digits of a number of its own, mixes them with what it
reads, and writes them down; every execution leaves a line in a log, so that they can be counted."""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tumortrack.core.errors import NoEstimate
from tumortrack_lab.fleet.task import File, Needs, Task


def mix(inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path, cores: int) -> None:
    """Digests of the inputs, hashed over and over for ``seconds``' worth of rounds."""
    note(options, "begun")
    value = hashlib.sha256(repr(sorted(options.items())).encode()).digest()
    for name in sorted(inputs):
        path = inputs[name] / "value" if inputs[name].is_dir() else inputs[name]
        value = hashlib.sha256(value + path.read_bytes()).digest()
    misbehave(options)
    time.sleep(options.get("wait_s", 0.0))
    value = hashlib.pbkdf2_hmac("sha256", value, b"fleet", options.get("rounds", 1000))
    (out / "value").write_bytes(value)
    (out / "folder").mkdir()
    (out / "folder" / "text.txt").write_text(f"{value.hex()}\n")
    note(options, "done")


def note(options: Mapping[str, Any], what: str) -> None:
    """A line in the log of executions: one write, so that lines of several processes stay whole."""
    if log := os.environ.get("FLEET_LOG"):
        with open(log, "ab", buffering=0) as stream:
            stream.write(f"{what} {options['name']} {os.getpid()}\n".encode())


def misbehave(options: Mapping[str, Any]) -> None:
    """Once, or for ever, what can go wrong."""
    log = os.environ.get("FLEET_LOG")
    text = Path(log).read_text() if log else ""
    first = text.count(f"begun {options['name']} ") == 1
    match options.get("fault"):
        case "impossible":
            raise NoEstimate(f"nothing can be said of {options['name']}")
        case "killed" if first:
            os.kill(os.getpid(), signal.SIGKILL)
        case "memory" if first:
            raise MemoryError("no room")
        case "disk" if first:
            raise OSError(28, "No space left on device", "out")
        case "defect":
            raise KeyError("defect")


def chain(number: int, *, length: int = 3, fault: str = "", **options: Any) -> Task:
    """The last of ``length`` tasks of a patient, each of which reads the one before; a fault is in
    the second."""
    task = None
    for step in range(length):
        more = {"fault": fault} if fault and step == 1 else {}
        task = Task(
            f"P{number}", f"step{step}", 1, mix,
            {"name": f"P{number}-{step}", "number": number, **options, **more},
            {} if task is None else {"before": task}, Needs(1, 100),
        )  # fmt: skip
    assert task is not None
    return task


def results(store: Path) -> dict[str, bytes]:
    """Every file of a plain store but for costs and what is aside, by its path."""
    return {
        str(path.relative_to(store)): path.read_bytes()
        for path in _files(store)
        if path.relative_to(store).parts[0] not in ("costs", "aside")
    }


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def user_file(path: Path) -> File:
    return File(str(path), hashlib.sha256(path.read_bytes()).hexdigest())
