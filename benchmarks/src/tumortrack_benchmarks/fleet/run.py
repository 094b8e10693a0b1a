"""Results of steps in a folder, addressed by what decides them; and patients one after the other,
or as Ray's tasks on any number of machines.

    STORE/KK/KEY/...          what a step wrote (KK: the first two letters of its key)
    STORE/KK/KEY/seal.json    sha256 of its files; or why the patient's data rule it out

A folder is written aside and renamed: it is whole, or not there.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import tumortrack
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError, StorageError, TumortrackError
from tumortrack.core.process import available_cores

_SEAL = "seal.json"
_SHOWN_S = 0.5  # between looks at what has ended
# Arguments: the folders of inputs by name, options, an empty folder to write into. The same inputs
# and options give the same files bit for bit: no file states a time, a path or a host. Raises
# TumortrackError: it cannot be done with these inputs.
Work = Callable[[Mapping[str, Path], Mapping[str, Any], Path], None]


@dataclass(frozen=True, eq=False)
class File:
    """A user's file or folder: where it is, and the sha256 of its content."""

    path: str
    key: str


@dataclass(frozen=True, eq=False)
class Step:
    """One step of one patient; ``version`` rises when its result changes."""

    name: str
    version: int
    work: Work
    options: Mapping[str, Any]  # of JSON's kinds
    inputs: Mapping[str, Step | File]

    @cached_property
    def key(self) -> str:
        """sha256 of all that the result depends on."""
        about = {"step": self.name, "version": self.version, "options": dict(self.options)}
        about["inputs"] = {name: source.key for name, source in self.inputs.items()}
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()

    def place(self, held: Path) -> Path:
        return held / self.key[:2] / self.key


class ImpossibleError(Exception):
    """The patient's data rule out a step."""

    def __init__(self, step: str, reason: str) -> None:
        super().__init__(step, reason)
        self.step, self.reason = step, reason


@dataclass(frozen=True)
class Outcome:
    """How a patient ended. there: done before; cannot: the data rule it out, as the store says from
    now on; failed: after all tries; the next run tries again. ``key``: of the last step."""

    state: Literal["there", "done", "cannot", "failed"]
    step: str = ""
    reason: str = ""
    key: str = ""


def is_whole(folder: Path) -> bool:
    """Whether all files of a result are there, with their sha256."""
    try:
        files = store.read_json(folder / _SEAL)["files"]
        return all(store.sha256_of(folder / name) == digest for name, digest in files.items())
    except (ArtifactError, KeyError, OSError):
        return False


def made(step: Step, held: Path, again: bool = False) -> Path:
    """A step's result, and before it those of its inputs, where the store lacks them. ``again``:
    also what it says cannot be done. Raises ImpossibleError; any other error may be the machine's.
    """
    folder = step.place(held)
    reason = store.read_json(folder / _SEAL)["failure"] if is_whole(folder) else None
    if reason is None or (again and reason):
        inputs = {
            name: _read(source) if isinstance(source, File) else made(source, held, again)
            for name, source in step.inputs.items()
        }
        store.remove(folder)
        reason = _make(step, inputs, folder)
    if reason:
        raise ImpossibleError(step.name, reason)
    return folder


def _make(step: Step, inputs: Mapping[str, Path], folder: Path) -> str:
    """Returns why it cannot be done."""
    reason, files = "", dict[str, str]()
    try:
        with store.new_folder(folder) as aside:
            try:
                step.work(inputs, step.options, aside)
                paths = (path for path in sorted(aside.rglob("*")) if path.is_file())
                files = {str(p.relative_to(aside)): store.sha256_of(p) for p in paths}
            except StorageError:  # the disk's, not the patient's
                raise
            except TumortrackError as error:
                reason = f"{type(error).__name__}: {error}"
                for name, path in (*inputs.items(), ("OUT", aside)):
                    reason = reason.replace(str(path), name)  # the same on every machine
            store.write_json(aside / _SEAL, {"failure": reason, "files": files})
    except InputError:
        if not is_whole(folder):  # else another run was faster
            raise
    return reason


def _read(file: File) -> Path:
    path = Path(file.path)
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there (on this machine)")
    if store.sha256_of(path) != file.key:
        raise OSError(f"{path} was changed after it was looked at; start again.")
    return path


def done(last: Callable[[], Step], held: Path, again: bool, version: str) -> Outcome:
    """A patient's last step, and all before it, on this machine."""
    if version != tumortrack.__version__:
        raise RuntimeError(f"{os.uname().nodename} has tumortrack {tumortrack.__version__}")
    step = last()
    try:
        state: Literal["there", "done"] = "there" if is_whole(step.place(held)) else "done"
        made(step, held, again)
        return Outcome(state, key=step.key)
    except ImpossibleError as error:
        return Outcome("cannot", error.step, error.reason, step.key)


def in_turn(
    patients: Mapping[str, Callable[[], Step]], held: Path, again: bool, tries: int
) -> Iterator[tuple[str, Outcome] | None]:
    """Outcomes by name, in this process; None: nothing has ended."""
    for name, last in patients.items():
        for left in reversed(range(tries)):
            try:
                yield name, done(last, held, again, tumortrack.__version__)
                break
            except Exception as error:
                if not left:
                    yield name, Outcome("failed", reason=_words(error))


def on_ray(
    patients: Mapping[str, Callable[[], Step]], held: Path, again: bool, tries: int,
    address: str | None, cores: int | None,
) -> Iterator[tuple[str, Outcome] | None]:  # fmt: skip
    """The same by Ray, as they end: on this machine, or the cluster at ``address``. Raises
    InputError: no cluster there."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    options: dict[str, Any] = {"address": address}
    if address is None:  # protect it from other users of the machine
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        options = {"num_cpus": cores or available_cores(), "include_dashboard": False}
    import ray

    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:  # of any kind: Ray raises them so
        where = f"the Ray cluster at {address}" if address else "Ray on this machine"
        words = str(error).strip().splitlines()[0]
        raise InputError(f"{where} cannot be used: {words}") from error
    try:  # each patient has a process of its own, whose memory is free again when it ends
        task = ray.remote(max_calls=1, max_retries=tries - 1, retry_exceptions=True)(done)
        version = tumortrack.__version__
        pending = {
            task.options(name=name).remote(last, held, again, version): name
            for name, last in patients.items()
        }
        while pending:
            ended, _ = ray.wait([*pending], timeout=_SHOWN_S)
            if not ended:
                yield None
            for one in ended:
                try:
                    outcome = ray.get(one)
                except ray.exceptions.RayError as error:
                    outcome = Outcome("failed", reason=_words(error))
                yield pending.pop(one), outcome
    finally:
        ray.shutdown()


def _words(error: Exception) -> str:
    lines: Sequence[str] = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[-1].strip()}"
