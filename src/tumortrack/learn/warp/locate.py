"""A cloud's motion: the network's placements, each refined, and the one that fits best."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tumortrack.learn.warp.motion import WarpMotion
from tumortrack.learn.warp.network import Placement, WarpNetwork
from tumortrack.learn.warp.refine import RefineConfig, Refined, refine
from tumortrack.learn.warp.shape import Shape

_SURE = 6.0  # logits: the other way round is not even tried
_TURNS = 8  # of a start that does not fit


@torch.no_grad()
def first_motions(
    network: WarpNetwork, shape: Shape, points_mm: Float[np.ndarray, "n 3"]
) -> list[WarpMotion]:
    """What the network sees in a cloud (camera frame, mm), the likelier way round first; the other
    one only where it may be right."""
    device = next(network.parameters()).device
    cloud = torch.tensor(np.asarray(points_mm, np.float32), device=device)[None]
    ways = sorted(network.both_ways(cloud), key=lambda way: -float(way.right_way))
    if float(ways[0].right_way - ways[1].right_way) > _SURE:
        ways = ways[:1]
    return [_motion(way, shape) for way in ways]


def best_fit(
    shape: Shape,
    points_mm: Float[np.ndarray, "n 3"],
    starts: list[WarpMotion],
    config: RefineConfig,
    usual_cost: float = math.inf,
) -> Refined:
    """The refined start of the least cost; where that is more than usual, also the likeliest start
    turned about the camera's axis, which repairs most starts that are wrong altogether."""
    fits = (refine(shape, points_mm, start, config) for start in starts)
    fit = min(fits, key=lambda fit: fit.cost)
    return repaired(shape, points_mm, starts[0], config, fit) if fit.cost > usual_cost else fit


def repaired(
    shape: Shape,
    points_mm: Float[np.ndarray, "n 3"],
    start: WarpMotion,
    config: RefineConfig,
    fit: Refined,
) -> Refined:
    """The best of a fit and those of a start turned about the camera's axis."""
    turned = (refine(shape, points_mm, turn, config) for turn in _turned(start))
    return min((fit, *turned), key=lambda fit: fit.cost)


def _turned(start: WarpMotion) -> list[WarpMotion]:
    """The undeformed organ in the same place, turned all around the camera's axis."""
    angles = np.arange(_TURNS) * 360 / _TURNS
    turns = Rotation.from_euler("z", angles[:, None], degrees=True).as_matrix()
    rest = start.shape.body.mean
    return [WarpMotion(start.shape, turn @ start.rotation, start.centre_mm, rest) for turn in turns]


def _motion(way: Placement, shape: Shape) -> WarpMotion:
    rotation, centre, coefficients = (
        value[0].double().cpu().numpy() for value in (way.rotation, way.centre_mm, way.coefficients)
    )
    return WarpMotion(shape, rotation, centre, coefficients)
