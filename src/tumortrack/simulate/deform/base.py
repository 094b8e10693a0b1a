"""What every deformation model offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from tumortrack.core.types import Anatomy

if TYPE_CHECKING:
    from tumortrack.simulate.elastic.body import ElasticBody

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class View:
    """The undeformed organ as the camera sees it: what a deformation may be sampled from."""

    anatomy_ct: Anatomy
    # visible(points_ct) -> bool each: nothing before the point, and the point in the picture
    visible: Callable[[np.ndarray], np.ndarray]
    body: ElasticBody | None = None  # where the deformation's configuration asks for one


@runtime_checkable
class Deformation(Protocol):
    """A sampled deformation, a map of space."""

    def apply(self, points_ct: Points) -> Points:
        """New positions (float32) of points, CT frame, mm."""
        ...

    def record(self) -> dict[str, Any]:
        """The sampled parameters as JSON types."""
        ...
