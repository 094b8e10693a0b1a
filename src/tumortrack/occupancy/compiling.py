"""Measures which arithmetic answers a model's queries fastest on this machine."""

from __future__ import annotations

import statistics
import time
from itertools import product

import numpy as np
import torch
from jaxtyping import Float32

from tumortrack.occupancy.arithmetic import CHUNK, Arithmetic, possible
from tumortrack.occupancy.compiled import SCHEMA, ArithmeticTiming, Compiled, this_machine
from tumortrack.occupancy.inference import Inference
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import Latent, OccupancyNetwork

QUERIES = 10_000
_CHUNKS = (1024, 2048, 4096)
_ROUNDS = 5
ENOUGH_EQUAL = 0.999
_POINTS = 1000
_DISTANCE_MM = 130.0
_FLATTER = (1.0, 0.6, 0.45)  # half axes of a kidney's upper side, about


def measured(model: OccupancyModel, weights_sha256: str, rounds: int = _ROUNDS) -> Compiled:
    """Every way that this machine offers, in turns, on a cloud of about the organ's size.

    How fast products of matrices are does not depend on what is in them, so no real cloud is
    needed; the labels compared are those of the network in single precision.
    """
    network = model.network
    rng = np.random.default_rng(0)
    cloud = like_an_organ(model.familiar.spread_mm[1], rng)
    ways = _ways(next(network.parameters()).device)
    inferences = [Inference(network, way) for way in ways]
    latent = inferences[0].encode(cloud)
    lower, upper = model.query_box_mm + np.median(cloud, axis=0)
    queries = rng.uniform(lower, upper, (QUERIES, 3)).astype(np.float32)
    seconds: list[list[float]] = [[] for _ in ways]
    answers = [one.logits(latent, queries) for one in inferences]  # the first call lays out
    for _, (n, one) in product(range(rounds), enumerate(inferences)):
        start = time.perf_counter()
        one.logits(latent, queries)
        seconds[n].append(time.perf_counter() - start)
    right = reference(inferences[0].network, latent, queries)
    timings = [
        ArithmeticTiming(
            arithmetic=way,
            milliseconds=1000 * statistics.median(taken),
            labels_equal=float((answer.argmax(1) == right.argmax(1)).double().mean()),
            largest_error=float((answer - right).abs().max()),
        )
        for way, taken, answer in zip(ways, seconds, answers, strict=True)
    ]
    return Compiled(
        schema=SCHEMA,
        weights_sha256=weights_sha256,
        machine=this_machine(),
        threads=torch.get_num_threads(),
        queries=QUERIES,
        arithmetic=chosen(timings).arithmetic,
        timings=tuple(timings),
    )


def chosen(timings: list[ArithmeticTiming]) -> ArithmeticTiming:
    """The fastest way that gives ``ENOUGH_EQUAL`` of the labels of single precision; where none
    does, the one that gives most."""
    right = [one for one in timings if one.labels_equal >= ENOUGH_EQUAL]
    if right:
        return min(right, key=lambda one: one.milliseconds)
    return max(timings, key=lambda one: one.labels_equal)


def _ways(device: torch.device) -> list[Arithmetic]:
    """The network as it is in one size of chunks, for comparison; the others in several."""
    as_it_is, *faster = possible(device)
    ways = [Arithmetic(numbers=as_it_is, chunk=CHUNK)]
    return ways + [
        Arithmetic(numbers=numbers, chunk=chunk) for numbers, chunk in product(faster, _CHUNKS)
    ]


def like_an_organ(half_mm: float, rng: np.random.Generator) -> Float32[np.ndarray, "n 3"]:
    """The upper side of an ellipsoid before the camera, ``half_mm`` its longest half axis."""
    directions = rng.normal(size=(_POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = -np.abs(directions[:, 2])
    return (directions * _FLATTER * half_mm + [0, 0, _DISTANCE_MM]).astype(np.float32)


@torch.inference_mode()
def reference(
    folded: OccupancyNetwork, latent: Latent, queries_mm: Float32[np.ndarray, "n 3"]
) -> torch.Tensor:
    """The network's own logits in single precision, (n, classes)."""
    parts = torch.from_numpy(queries_mm)[None].split(CHUNK, dim=1)
    return torch.cat([folded.query(latent, part)[0] for part in parts])
