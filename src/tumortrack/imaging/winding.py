"""Does a mesh enclose everything exactly once?"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tumortrack.core.types import Mesh
from tumortrack.imaging.raster import winding_numbers


def grid_round(
    box_mm: Float[np.ndarray, "2 3"], step_mm: float, margin_mm: float
) -> tuple[Float[np.ndarray, "4 4"], tuple[int, int, int]]:
    """``frame_from_index`` and shape of an axis-aligned grid that holds a box and a margin."""
    frame_from_index = np.diag([step_mm, step_mm, step_mm, 1.0])
    frame_from_index[:3, 3] = box_mm[0] - margin_mm
    counts = np.ceil((box_mm[1] - box_mm[0] + 2 * margin_mm) / step_mm).astype(int) + 1
    return frame_from_index, (int(counts[0]), int(counts[1]), int(counts[2]))


def is_simple(mesh: Mesh, step_mm: float) -> bool:
    """True where rays along all three axes find only winding numbers 0 and 1."""
    for turn in range(3):
        turned = mesh.moved(np.roll(mesh.vertices_mm, turn, axis=1))
        numbers = winding_numbers(turned, *grid_round(turned.box_mm, step_mm, 2 * step_mm))
        # Slivers thinner than rounding may swap their two faces: single columns do not decide.
        wrong = ((numbers < 0) | (numbers > 1)).any(2) | (numbers[:, :, -1] != 0)
        if wrong.sum() > 2:
            return False
    return True
