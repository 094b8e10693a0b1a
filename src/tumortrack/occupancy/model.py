"""A `quick` or `paper` model: the network, and the arithmetic that answers its queries fastest.

`tumortrack compile` measures that. MODEL/compiled holds one JSON file per machine and number of
threads. It is data: it chooses among this library's own arithmetics, each of which gives the
network's labels, so that a stranger's file may cost time and nothing else; nothing in it is ever
run. The model's own files and manifest stay as they were.
"""

from __future__ import annotations

import hashlib
import statistics
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float32, Float64

from tumortrack.core import store
from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.models.folder import WEIGHTS
from tumortrack.models.model import Model
from tumortrack.occupancy.inference import CHUNK, Arithmetic, Inference, possible
from tumortrack.occupancy.network import OccupancyNetwork

FOLDER = "compiled"
SCHEMA = 2
QUERIES = 10_000
ENOUGH_EQUAL = 0.999
_CHUNKS = (1024, 2048, 4096)
_FLATTER = (1.0, 0.6, 0.45)  # half axes of a kidney's upper side, about


class Machine(Config, frozen=True):
    """What the choice depends on besides the weights."""

    torch: str
    processor: str
    instructions: tuple[str, ...]


class ArithmeticTiming(Config, frozen=True):
    """One arithmetic's median time, and how it differs from single precision."""

    arithmetic: Arithmetic
    milliseconds: float
    labels_equal: float
    largest_error: float  # of a logit


class Compiled(Config, frozen=True):
    """``arithmetic``: the fastest. ``queries``: in each measurement."""

    schema: int
    weights_sha256: str
    machine: Machine
    threads: int
    queries: int
    arithmetic: Arithmetic
    timings: tuple[ArithmeticTiming, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class OccupancyModel(Model):
    """See ``Model``; ``arithmetic`` is what `tumortrack compile` found fastest on this machine."""

    new_network = OccupancyNetwork

    network: OccupancyNetwork
    arithmetic: Arithmetic | None = None

    @classmethod
    def from_folder(cls, folder: Path, manifest: dict[str, Any], **known: Any) -> OccupancyModel:
        if next(known["network"].parameters()).device.type != "cpu":
            return cls(**known)
        arithmetic, note = find(folder, str(manifest["files"][WEIGHTS]))
        return cls(arithmetic=arithmetic, notes=() if note is None else (note,), **known)


def this_machine() -> Machine:
    """This processor and PyTorch."""
    has = torch.cpu.get_capabilities()
    vector = ("avx", "amx", "asimd", "sve")
    return Machine(
        torch=str(torch.__version__),
        processor=str(has.get("cpu_name", "unknown")),
        instructions=tuple(sorted(n for n, v in has.items() if v is True and n.startswith(vector))),
    )


def place_of(folder: Path, machine: Machine, threads: int) -> Path:
    """The file of a machine and number of threads in a model folder."""
    digest = hashlib.sha256(msgspec.json.encode((machine, threads))).hexdigest()
    return folder / FOLDER / f"{digest[:16]}.json"


def save(folder: Path, compiled: Compiled) -> Path:
    """Write it into a model folder, over an older one of the same machine and threads; StorageError
    where the disk refuses."""
    path = place_of(folder, compiled.machine, compiled.threads)
    with store.writing(path.parent):
        path.parent.mkdir(exist_ok=True)
    store.write_json(path, to_builtins(compiled))
    return path


def find(folder: Path, weights_sha256: str) -> tuple[Arithmetic | None, str | None]:
    """The fastest arithmetic on this machine, with as many threads as now, for these weights; or
    None and one line that says why it is unknown."""
    machine, threads = this_machine(), torch.get_num_threads()
    path = place_of(folder, machine, threads)
    again = f"the usual arithmetic is used. `tumortrack compile {folder}` measures what is faster."
    try:
        if not path.is_file():
            elsewhere = f"only for other machines, PyTorches or threads ({threads} here)"
            where = elsewhere if any(path.parent.glob("*.json")) else "on no machine yet"
            return None, f"this model was compiled {where}; {again}"
        compiled = read(path)
    except OSError as error:
        return None, f"{path.parent} cannot be read ({error.strerror}); {again}"
    except ArtifactError as error:
        return None, f"{error} So {again}"
    measured = (compiled.weights_sha256, compiled.machine, compiled.threads)
    if measured != (weights_sha256, machine, threads):
        return None, f"this model was compiled for other weights; {again}"
    if compiled.arithmetic.numbers not in possible(torch.device("cpu")):
        return None, f"{path} names arithmetic that this processor does not have; {again}"
    return compiled.arithmetic, None


def read(path: Path) -> Compiled:
    """One file of MODEL/compiled; ArtifactError where it is damaged or of another schema."""
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
        best, here = one.arithmetic, one.machine == this_machine()
        lines.append(
            f"{FOLDER}/{path.name}: {best.numbers}, {best.chunk} queries at once, for "
            f"{one.threads} thread{'s' * (one.threads > 1)} of {one.machine.processor}, PyTorch "
            f"{one.machine.torch}{' (this machine)' * here}"
        )
    return lines


def measured(
    network: OccupancyNetwork,
    query_box_mm: Float64[np.ndarray, "2 3"],
    half_mm: float,
    weights_sha256: str,
    rounds: int = 5,
) -> Compiled:
    """Every arithmetic that this machine offers, in interleaved rounds, on a cloud of about the
    organ's size (``half_mm``: its longest half axis). How fast products of matrices are does not
    depend on what is in them, so no real cloud is needed; the labels compared are those of the
    network in single precision."""
    rng = np.random.default_rng(0)
    cloud = like_an_organ(half_mm, rng)
    # The network as it is with one size of chunks, for comparison; the others with several.
    as_it_is, *faster = possible(next(network.parameters()).device)
    sizes = [(as_it_is, CHUNK), *product(faster, _CHUNKS)]
    choices = [Arithmetic(numbers=numbers, chunk=chunk) for numbers, chunk in sizes]
    inferences = [Inference(network, choice) for choice in choices]
    latent = inferences[0].encode(cloud)
    lower, upper = query_box_mm + np.median(cloud, axis=0)
    queries = rng.uniform(lower, upper, (QUERIES, 3)).astype(np.float32)
    seconds: list[list[float]] = [[] for _ in choices]
    answers = [one.logits(latent, queries) for one in inferences]  # the first call lays out
    for _, (n, one) in product(range(rounds), enumerate(inferences)):
        start = time.perf_counter()
        one.logits(latent, queries)
        seconds[n].append(time.perf_counter() - start)
    with torch.inference_mode():  # in single precision
        parts = torch.from_numpy(queries)[None].split(CHUNK, dim=1)
        truth = torch.cat([inferences[0].network.query(latent, part)[0] for part in parts])
    timings = [
        ArithmeticTiming(
            arithmetic=choice,
            milliseconds=1000 * statistics.median(taken),
            labels_equal=float((answer.argmax(1) == truth.argmax(1)).double().mean()),
            largest_error=float((answer - truth).abs().max()),
        )
        for choice, taken, answer in zip(choices, seconds, answers, strict=True)
    ]
    # The fastest that gives enough of the labels; where none does, the one that gives most.
    right = [one for one in timings if one.labels_equal >= ENOUGH_EQUAL]
    fastest = min(right, key=lambda one: one.milliseconds, default=None)
    best = fastest or max(timings, key=lambda one: one.labels_equal)
    return Compiled(
        schema=SCHEMA,
        weights_sha256=weights_sha256,
        machine=this_machine(),
        threads=torch.get_num_threads(),
        queries=QUERIES,
        arithmetic=best.arithmetic,
        timings=tuple(timings),
    )


def like_an_organ(half_mm: float, rng: np.random.Generator) -> Float32[np.ndarray, "n 3"]:
    """An ellipsoid's upper side, 130 mm before the camera; ``half_mm``: its longest half axis."""
    directions = rng.normal(size=(1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = -np.abs(directions[:, 2])
    return (directions * _FLATTER * half_mm + [0, 0, 130.0]).astype(np.float32)
