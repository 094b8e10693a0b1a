"""Small real steps for the fleet: each hashes its name with what it reads, and writes that down.

What goes wrong with them says ``faults.json`` in the folder named by FLEET_FOLDER, since it must
not be part of their keys; every execution leaves a line in ``log`` beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from tumortrack.core.errors import NoEstimate
from tumortrack_benchmarks.fleet.run import File, Step


def mix(inputs: Mapping[str, Path], options: Mapping[str, Any], out: Path) -> None:
    folder, name = Path(os.environ["FLEET_FOLDER"]), options["name"]
    with (folder / "log").open("ab", buffering=0) as stream:  # one write: lines stay whole
        stream.write(f"{name}\n".encode())
    if options.get("impossible"):
        raise NoEstimate(f"nothing can be said of {inputs['before']}")
    faults = json.loads((folder / "faults.json").read_text())
    time.sleep(faults.get("wait_s", 0.0))
    fault = faults.get(name)
    if fault == "defect":
        raise KeyError(name)
    if fault and executions(folder).count(name) == 1:
        if fault == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(28, "No space left on device")
    value = hashlib.sha256(name.encode())
    for source in sorted(inputs):
        path = inputs[source] / "value" if inputs[source].is_dir() else inputs[source]
        value.update(path.read_bytes())
    (out / "value").write_bytes(value.digest())


def last(number: int, impossible: bool = False, source: File | None = None) -> Step:
    """The last of three steps of a patient, each of which reads the one before."""
    inputs: dict[str, Step | File] = {} if source is None else {"source": source}
    for n in range(3):
        options: dict[str, Any] = {"name": f"P{number}-{n}"}
        if impossible and n == 1:
            options["impossible"] = True
        step = Step(f"step{n}", 1, mix, options, inputs)
        inputs = {"before": step}
    return step


def patients(count: int) -> dict[str, Callable[[], Step]]:
    """The second one can't be done."""
    return {f"P{n}": partial(last, n, n == 1) for n in range(count)}


def executions(folder: Path) -> list[str]:
    """Names of steps as often as they were begun."""
    log = folder / "log"
    return log.read_text().split() if log.exists() else []


def drive(held: Path, count: int) -> None:
    """So many patients by Ray on two cores."""
    from tumortrack_benchmarks.fleet.run import on_ray

    for ended in on_ray(patients(count), held, False, 3, None, 2):
        if ended is not None:
            name, outcome = ended
            print(json.dumps([name, outcome.state, outcome.step, outcome.reason]), flush=True)
