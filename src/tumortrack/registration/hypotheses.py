"""A cloud's motion: the network's placements, each refined, and the one that fits best."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tumortrack.core.process import parallel_for
from tumortrack.registration.gauss_newton import GaussNewton, GaussNewtonConfig, RegistrationResult
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import PoseHypothesis, RegistrationNetwork
from tumortrack.registration.rest_shape import RestShape

_SURE = 6.0  # logits: the other way round is not even tried
_TURNS = 8  # of a start that does not fit

# Of 840 clouds of four organs, of drags, elastic states and the digital twin's, none had a best
# start that after six steps cost more than 2.5 times what another did; two thirds of the wrong
# ways round cost more than three times.
# (Of the turned starts: never more than twice.)
_HEAT = 6  # steps that every start goes
_BEHIND = 3.0  # times the least cost: goes no farther


@contextmanager
def _one_thread() -> Iterator[None]:
    """For a network so small that a second thread saves nothing: after its part it would wait
    busily for more, milliseconds long, on the core where the refinement wants to run.

    The number is the whole process's: nothing else should start to use torch meanwhile.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@torch.no_grad()
def first_motions(
    network: RegistrationNetwork, shape: RestShape, points_mm: Float[np.ndarray, "n 3"]
) -> list[ElasticMotion]:
    """What the network sees in a cloud (camera frame, mm), the likelier way round first; the other
    one only where it may be right."""
    device = next(network.parameters()).device
    cloud = torch.tensor(np.asarray(points_mm, np.float32), device=device)[None]
    with _one_thread() if device.type == "cpu" else nullcontext():
        ways = sorted(network.both_ways(cloud), key=lambda way: -float(way.right_way))
    if float(ways[0].right_way - ways[1].right_way) > _SURE:
        ways = ways[:1]
    return [_motion(way, shape) for way in ways]


def best_fit(
    shape: RestShape,
    points_mm: Float[np.ndarray, "n 3"],
    starts: list[ElasticMotion],
    config: GaussNewtonConfig,
    usual_cost: float = math.inf,
) -> RegistrationResult:
    """The refined start of the least cost; where that is more than usual, also the likeliest start
    turned about the camera's axis, which repairs most starts that are wrong altogether."""
    fit = _best(shape, points_mm, starts, config)
    return repaired(shape, points_mm, starts[0], config, fit) if fit.cost > usual_cost else fit


def repaired(
    shape: RestShape,
    points_mm: Float[np.ndarray, "n 3"],
    start: ElasticMotion,
    config: GaussNewtonConfig,
    fit: RegistrationResult,
) -> RegistrationResult:
    """The best of a fit and those of a start turned about the camera's axis."""
    turned = _best(shape, points_mm, _turned(start), config)
    return min(fit, turned, key=lambda fit: fit.cost)


def _best(
    shape: RestShape,
    points_mm: Float[np.ndarray, "n 3"],
    starts: list[ElasticMotion],
    config: GaussNewtonConfig,
) -> RegistrationResult:
    """The refined start of the least cost. All go some steps; then those go on that may win."""
    left = [GaussNewton(shape, points_mm, start, config) for start in starts]
    for steps in (min(_HEAT, config.steps), config.steps):
        least = min(descent.cost for descent in left)
        left = [descent for descent in left if descent.cost <= _BEHIND * least]
        _all_run(left, steps)
    return min(left, key=lambda descent: descent.cost).refined()


def _all_run(descents: list[GaussNewton], steps: int) -> None:
    def run(part: slice) -> None:
        for descent in descents[part]:
            descent.run(steps)

    parallel_for(run, len(descents), 1)


def _turned(start: ElasticMotion) -> list[ElasticMotion]:
    """The undeformed organ in the same place, turned all around the camera's axis."""
    angles = np.arange(_TURNS) * 360 / _TURNS
    turns = Rotation.from_euler("z", angles[:, None], degrees=True).as_matrix()
    rest = start.shape.body.mean
    return [
        ElasticMotion(start.shape, turn @ start.rotation, start.centre_mm, rest) for turn in turns
    ]


def _motion(way: PoseHypothesis, shape: RestShape) -> ElasticMotion:
    rotation, centre, coefficients = (
        value[0].double().cpu().numpy() for value in (way.rotation, way.centre_mm, way.coefficients)
    )
    return ElasticMotion(shape, rotation, centre, coefficients)
