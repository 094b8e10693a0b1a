"""Small real tasks for the fleet: each hashes its number with what it reads, and writes that down.

What goes wrong with them, and how long they wait, says a file ``faults.json`` in the folder named
by FLEET_FOLDER, since it must not be part of their keys; every execution leaves a line in ``log``
beside it, so that they can be counted.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tumortrack.core.errors import NoEstimate, TumortrackError
from tumortrack_lab.fleet.task import File, Task


def mix(inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path) -> None:
    note("begun", options["name"])
    value = hashlib.sha256(repr(sorted(options.items())).encode()).digest()
    for name in sorted(inputs):
        path = inputs[name] / "value" if inputs[name].is_dir() else inputs[name]
        value = hashlib.sha256(value + path.read_bytes()).digest()
    if options.get("impossible"):
        raise NoEstimate(f"nothing can be said of {inputs['before']}")
    misbehave(options["name"], out)
    value = hashlib.pbkdf2_hmac("sha256", value, b"fleet", options["rounds"])
    (out / "manifest.json").write_text(json.dumps(value.hex()))  # as folders of ours have
    (out / "folder").mkdir()
    (out / "folder" / "name.txt").write_text(options["name"])
    (out / "value").write_bytes(value)
    note("done", options["name"])


def chain(number: int, impossible: bool = False, source: File | None = None) -> Task:
    """The last of three tasks of a patient, each of which reads the one before."""
    inputs: dict[str, Task | File] = {} if source is None else {"source": source}
    task = None
    for step in range(3):
        options: dict[str, Any] = {"name": f"P{number}-{step}", "rounds": 1000}
        if impossible and step == 1:
            options["impossible"] = True
        task = Task(f"P{number}", f"step{step}", 1, mix, options, inputs, 100)
        inputs = {"before": task}
    assert task is not None
    return task


def patients(count: int) -> list[Task]:
    """The second one can't be done."""
    return [chain(number, impossible=number == 1) for number in range(count)]


def note(what: str, name: str) -> None:
    """A line in the log: one write, so that lines of several processes stay whole."""
    with open(Path(os.environ["FLEET_FOLDER"]) / "log", "ab", buffering=0) as stream:
        stream.write(f"{what} {name} {os.getppid()}\n".encode())


def executions(folder: Path, parent: int | None = None) -> list[str]:
    """Names of tasks as often as they were begun, or were by children of this process."""
    log = folder / "log"
    lines = map(str.split, log.read_text().splitlines() if log.exists() else [])
    return [name for kind, name, of in lines if kind == "begun" and parent in (None, int(of))]


def misbehave(name: str, out: Path) -> None:
    """The fault of this task, when it is done for the first time; a defect every time."""
    folder = Path(os.environ["FLEET_FOLDER"])
    faults = json.loads((folder / "faults.json").read_text())
    time.sleep(faults.get("wait_s", 0.0))
    fault = faults.get(name)
    if fault == "defect":
        raise KeyError("defect")
    if fault is None or executions(folder).count(name) > 1:
        return
    if fault == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if fault == "memory":
        bytearray(2**62)
    if fault == "disk":  # is full for the moment
        _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
        try:
            (out / "large").write_bytes(bytes(8192))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def results(store: Path) -> dict[str, bytes]:
    """Every file of a plain store but for costs and claims, by its path."""
    return {
        str(path.relative_to(store)): path.read_bytes()
        for path in sorted(store.rglob("*"))
        if path.is_file() and path.relative_to(store).parts[0] not in ("costs", "claims")
    }


def stored(store: Path) -> set[str]:
    """Names of the tasks whose results lie in a plain store."""
    return {path.read_text() for path in store.glob("??/*/files/folder/name.txt")}


def drive(address: str, url: str, count: int) -> None:
    """Do so many patients on a cluster; a line of JSON each."""
    from tumortrack_lab.fleet import executors
    from tumortrack_lab.fleet.engine import run
    from tumortrack_lab.fleet.store import Store

    executors._SILENT_S = 3.0
    try:
        executor = executors.OnRay(address)
        for done in run(patients(count), Store(url), executor, tries=3):
            words = {"patient": done.task.patient, "state": done.state, "reason": done.reason}
            print(json.dumps({**words, "step": done.step}), flush=True)
    except TumortrackError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        sys.exit(error.exit_code)


def user_file(path: Path) -> File:
    return File(str(path), hashlib.sha256(path.read_bytes()).hexdigest())
