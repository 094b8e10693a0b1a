"""The organ on a lattice, asked only where it can be: coarse first, then outward from inside."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Float32

from tumortrack.core.types import OUTSIDE
from tumortrack.occupancy.lattice import LogitLattice, LogitsAt, lattice_over


def organ_lattice(
    logits_at: LogitsAt, box_mm: Float[np.ndarray, "2 3"], steps: int
) -> LogitLattice:
    """``lattice_over``, asked everywhere inside of the organ and a point or two about it.

    Every second point along each axis is asked first, then all within two of one that lies
    inside, then all about those that turn out to lie inside, until none is left. The others are
    linear between the first ones, all of them outside. Whatever hangs together with a part that
    holds one of the first points is met as if all were asked; what lies apart and between them is
    not, and would be dropped (``models.volume.keep_largest_pieces``).
    """
    from tumortrack.occupancy.sparse_kernels import halved, neighbours

    coarse = lattice_over(logits_at, box_mm, -(-steps // 2))
    i, j, k = (2 * n - 1 for n in coarse.logits.shape[:3])
    shape, step_mm = (i, j, k), coarse.step_mm / 2
    logits = np.empty((*shape, coarse.logits.shape[3]), np.float32)
    halved(coarse.logits, logits, 0, len(logits))
    rows = logits.reshape(-1, logits.shape[3])
    known = np.zeros(shape, bool)
    known[::2, ::2, ::2] = True
    flat = np.arange(math.prod(shape)).reshape(shape)[::2, ::2, ::2].ravel()
    known = known.ravel()
    first = neighbours(shape, _inside(flat, rows), known)
    asked = np.concatenate([first, neighbours(shape, first, known)])
    while len(asked):
        place = np.stack(np.unravel_index(asked, shape), axis=1) * step_mm + coarse.origin_mm
        rows[asked] = logits_at(place.astype(np.float32)).float().cpu().numpy()
        asked = neighbours(shape, _inside(asked, rows), known)
    return LogitLattice(coarse.origin_mm, step_mm, logits)


def leaves(lattice: LogitLattice) -> bool:
    """Whether the organ, the largest piece of what lies inside, reaches the border of a lattice, or
    is not in it at all."""
    from scipy import ndimage

    pieces, count = ndimage.label(lattice.logits.argmax(-1) != OUTSIDE)
    if not count:
        return True
    sizes = np.bincount(pieces.ravel())
    largest = 1 + int(sizes[1:].argmax())
    return bool(sizes[largest] > (pieces[1:-1, 1:-1, 1:-1] == largest).sum())


def _inside(flat: np.ndarray, rows: Float32[np.ndarray, "n classes"]) -> np.ndarray:
    return flat[rows[flat].argmax(1) != OUTSIDE]
