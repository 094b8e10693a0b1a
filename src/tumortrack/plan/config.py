"""Every choice of the planner."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.plan.values import Method

Direction = Literal["shortest", "clockwise", "anticlockwise"]
_ALLOWED = {
    "margin_mm": (1.0, 20.0),
    "sigmas": (0.0, 10.0),
    "spacing_mm": (0.2, 10.0),
    "layer_mm": (1.0, 20.0),
    "stroke_mm": (1.0, 30.0),
    "lead_mm": (0.0, 30.0),
    "least_exophytic": (0.0, 1.0),
    "most_healthy": (0.0, 1.0),
    "most_margin_mm": (20.0, 60.0),
}


class ResectionConfig(Config, frozen=True, kw_only=True):
    """How a tumor is to be cut out.

    Attributes:
        method: published: the paper's two sweeps round the tumor's projection; margin: layers that
            keep the margin in all directions.
        tumor: its part's name (tumor_1, ...); empty: the one that lies farthest out.
        margin_mm: least distance between tumor and cut (the paper's 5).
        sigmas: standard deviations of the estimate's own uncertainty that are added to the margin.
        spacing_mm: between points of a stroke.
        layer_mm: height of a layer, where the method is ``margin``.
        stroke_mm: width that one stroke of the horizontal instrument cuts.
        order: of layers, from the top down or from the floor up.
        direction: of strokes, seen from above; shortest: each from the end that is nearer to where
            the one before ended.
        lead_mm: strokes begin and end so far outside the organ.
        least_exophytic: a tumor with a smaller share outside the organ's hull lies wholly inside.
        most_healthy: the largest share of the organ's healthy tissue that a plan may take.
        most_margin_mm: the widest margin, with its uncertainty, anywhere.
    """

    method: Method = "margin"
    tumor: str = ""
    margin_mm: float = 5.0
    sigmas: float = 0.0
    spacing_mm: float = 1.0
    layer_mm: float = 4.0
    stroke_mm: float = 6.0
    order: Literal["down", "up"] = "down"
    direction: Direction = "shortest"
    lead_mm: float = 5.0
    least_exophytic: float = 0.05
    most_healthy: float = 0.5
    most_margin_mm: float = 20.0

    def __post_init__(self) -> None:
        for name, (low, high) in _ALLOWED.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} is {value:g}; allowed: {low:g} to {high:g}.")
