"""What `tumortrack compile` leaves in a model folder: which arithmetic is fastest on a machine.

MODEL/compiled holds one JSON file a machine and number of threads. It is data: it chooses among
ways of this library's own, each of which gives the network's labels, so that a file from a stranger
may cost time and nothing else; nothing in it is ever run. The model's own files and manifest stay
as they were.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import torch

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError, StorageError
from tumortrack.occupancy.arithmetic import Arithmetic, possible

FOLDER = "compiled"
SCHEMA = 2


class Machine(Config, frozen=True):
    """What the choice depends on besides the weights."""

    torch: str
    processor: str
    instructions: tuple[str, ...]


class ArithmeticTiming(Config, frozen=True):
    """One way, measured: median, and what differs from the network in single precision."""

    arithmetic: Arithmetic
    milliseconds: float
    labels_equal: float
    largest_error: float  # of a logit


class Compiled(Config, frozen=True):
    """``arithmetic``: the fastest. ``queries``: of each measurement."""

    schema: int
    weights_sha256: str
    machine: Machine
    threads: int
    queries: int
    arithmetic: Arithmetic
    timings: tuple[ArithmeticTiming, ...]


def this_machine() -> Machine:
    """The processor at hand and the PyTorch that drives it."""
    has = torch.cpu.get_capabilities()
    wide = sorted(name for name, there in has.items() if there is True and _matters(name))
    return Machine(
        torch=str(torch.__version__),
        processor=str(has.get("cpu_name", "unknown")),
        instructions=tuple(wide),
    )


def _matters(instruction: str) -> bool:
    return instruction.startswith(("avx", "amx", "asimd", "sve"))


def place_of(folder: Path, machine: Machine, threads: int) -> Path:
    """Where a model folder keeps what was measured on a machine with so many threads."""
    digest = hashlib.sha256(msgspec.json.encode((machine, threads))).hexdigest()
    return folder / FOLDER / f"{digest[:16]}.json"


def save(folder: Path, compiled: Compiled) -> Path:
    """Write it into a model folder, over an older one of the same machine and threads.

    Raises:
        StorageError: the disk refused.
    """
    path = place_of(folder, compiled.machine, compiled.threads)
    try:
        path.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {path.parent}: {error.strerror}.") from error
    store.write_json(path, to_builtins(compiled))
    return path


def find(folder: Path, weights_sha256: str) -> tuple[Arithmetic | None, str | None]:
    """What was found fastest here, with as many threads as now, for these weights; or None and one
    line that says why not."""
    machine, threads = this_machine(), torch.get_num_threads()
    path = place_of(folder, machine, threads)
    again = f"the usual arithmetic is used. `tumortrack compile {folder}` measures what is faster."
    try:
        there = path.is_file()
        others = len(list(path.parent.glob("*.json")))
    except OSError as error:
        return None, f"{path.parent} cannot be read ({error.strerror}); {again}"
    if not there:
        elsewhere = f"only for other machines, PyTorches or threads ({threads} here)"
        where = elsewhere if others else "on no machine yet"
        return None, f"this model was compiled {where}; {again}"
    try:
        compiled = read(path)
    except ArtifactError as error:
        return None, f"{error} So {again}"
    measured = (compiled.weights_sha256, compiled.machine, compiled.threads)
    if measured != (weights_sha256, machine, threads):
        return None, f"this model was compiled for other weights; {again}"
    if compiled.arithmetic.numbers not in possible(torch.device("cpu")):
        return None, f"{path} names arithmetic that this processor does not have; {again}"
    return compiled.arithmetic, None


def read(path: Path) -> Compiled:
    """One file of MODEL/compiled.

    Raises:
        ArtifactError: damaged, or of another schema.
    """
    content = store.read_json(path)
    if content.get("schema") != SCHEMA:
        raise ArtifactError(f"{path} is of another version of tumortrack.")
    try:
        return from_builtins(content, Compiled, str(path))
    except InputError as error:
        raise ArtifactError(str(error)) from error


def describe(folder: Path) -> list[str]:
    """A line for every machine and number of threads that the model was compiled for."""
    lines = []
    for path in sorted((folder / FOLDER).glob("*.json")):
        try:
            one = read(path)
        except ArtifactError as error:
            lines.append(f"{FOLDER}/{path.name}: {error}")
            continue
        ways, here = one.arithmetic, one.machine == this_machine()
        lines.append(
            f"{FOLDER}/{path.name}: {ways.numbers}, {ways.chunk} queries at once, for "
            f"{one.threads} thread{'s' * (one.threads > 1)} of {one.machine.processor}, PyTorch "
            f"{one.machine.torch}{' (this machine)' * here}"
        )
    return lines
