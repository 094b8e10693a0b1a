"""The interface of deformation models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from tumortrack.core.types import Anatomy

if TYPE_CHECKING:
    from tumortrack.organ.body import ElasticBody

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class View:
    """The undeformed organ as the camera sees it, from which a deformation is sampled."""

    anatomy_ct: Anatomy
    # visible(points_ct) -> bool each: the point is in the image and not occluded
    visible: Callable[[np.ndarray], np.ndarray]
    body: ElasticBody | None = None  # if the deformation's configuration asks for one


@runtime_checkable
class Deformation(Protocol):
    """A sampled deformation, a map of space."""

    def apply(self, points_ct: Points) -> Points:
        """New positions (float32) of points, CT frame, mm."""
        ...

    def record(self) -> dict[str, Any]:
        """The sampled parameters as JSON types."""
        ...
