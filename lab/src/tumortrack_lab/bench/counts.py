"""How much arithmetic a part has to do: counted by torch for modules, by formulas elsewhere.

A multiplication and an addition are 2. Comparisons, square roots and exponentials are 1 each:
formulas are meant to be right within some tens of per cent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn

_SAMPLE = 60  # trilinear value of three components: 8 weights, 24 products, the place
_SQUARE = 8  # a squared distance in space
_DRAG = 16  # square, exponential, three products and sums


def module_flops(call: Callable[[], object]) -> float:
    """Of the matrix products and convolutions in a call, by ``torch.utils.flop_counter``."""
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        call()
    return float(counter.get_total_flops())


def weight_bytes(module: nn.Module, bytes_each: int) -> float:
    """Of all weights, moved once."""
    return float(bytes_each * sum(weight.numel() for weight in module.parameters()))


def farthest_flops(points: int, chosen: int) -> float:
    """Farthest point sampling: each choice compares all points with the newest."""
    return float(points * chosen * (_SQUARE + 2))


def ball_flops(points: int, centres: int) -> float:
    """Neighbours of centres, every point tried."""
    return float(points * centres * (_SQUARE + 1))


def flow_flops(points: int, steps: int) -> float:
    """Points that follow a velocity field on a lattice: one sample a step and one to begin."""
    return float(points * (steps + 1) * (_SAMPLE + 12))


def drag_flops(points: int, drags: int) -> float:
    """Points moved by drags one after another."""
    return float(points * drags * _DRAG)


def blend_flops(values: int, modes: int) -> float:
    """A field of so many values as a sum of modes."""
    return float(2 * values * modes)


def draw_flops(triangles: int, pixels: int) -> float:
    """A z-buffer: corners projected and edges set up once a triangle, three edges and a depth
    worked out at each pixel that the organ covers, about twice."""
    return float(60 * triangles + 2 * 20 * pixels)


def refine_flops(points: int, unknowns: int, steps: int, flow_steps: int) -> float:
    """Gauss-Newton steps: each carries the points back, looks distance and slope up, carries them
    half the way, projects the modes there, and sums the curvature (symmetric: half of it)."""
    a_point = 2 * flow_flops(1, flow_steps) + _SAMPLE + 8 * 2 * 3 * unknowns + unknowns**2
    return float(steps * (points * a_point + unknowns**3 / 3))
