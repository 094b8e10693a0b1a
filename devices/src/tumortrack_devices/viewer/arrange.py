"""Which way labels of places near each other hang, so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

Anchor = Literal[
    "bottom-left", "top-left", "top-right", "bottom-right",
    "center-left", "center-right", "top-center", "bottom-center",
]  # fmt: skip
"""Which corner, or middle of a side, of a label lies at its place."""

ANCHORS: tuple[Anchor, ...] = get_args(Anchor)
_ALONG = {"left": 0.0, "center": -0.5, "right": -1.0}
_DOWN = {"top": 0.0, "center": -0.5, "bottom": -1.0}
# Left and top of a box that hangs so, in its own width and height, from its place.
_CORNERS = np.array([
    (_ALONG[across], _DOWN[down]) for down, across in (anchor.split("-") for anchor in ANCHORS)
])  # fmt: skip
_OVERLAP, _OUTSIDE, _CHANGED, _RANK = 1e3, 1.0, 0.1, 1e-3  # what is worst first


def boxes(
    places: Float[np.ndarray, "n 2"], sizes: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n anchors 2 2"]:
    """Low and high corner of each label, hung in each way. x right, y down."""
    low = places[:, None] + _CORNERS * sizes[:, None]
    return np.stack([low, low + sizes[:, None]], axis=2)


def arranged(
    places: Float[np.ndarray, "n 2"],
    sizes: Float[np.ndarray, "n 2"],
    half: Float[np.ndarray, " 2"],
    before: Sequence[Anchor] = (),
) -> list[Anchor]:
    """How to hang up to four labels of ``sizes`` at ``places``, from the middle of a view that
    reaches ``half`` to each side: with the least overlap, then the least outside, then as
    ``before``. Whatever is apart stays so with smaller labels, as they shrink to their places."""
    count, kinds = len(places), len(ANCHORS)
    if not count:
        return []
    hung = boxes(places, sizes)
    whole = sizes.prod(axis=1)[:, None]
    inside = np.minimum(hung[:, :, 1], half) - np.maximum(hung[:, :, 0], -half)
    alone = _OUTSIDE * (1 - inside.clip(0).prod(axis=2) / whole) + _RANK * np.arange(kinds)
    for one, anchor in enumerate(before[:count]):
        alone[one] += _CHANGED * (np.arange(kinds) != ANCHORS.index(anchor))
    axes = [tuple(kinds if k == n else 1 for k in range(count)) for n in range(count)]
    cost = sum(alone[n].reshape(axes[n]) for n in range(count)) + np.zeros((kinds,) * count)
    for one, other in combinations(range(count), 2):
        high = np.minimum(hung[one][:, None, 1], hung[other][None, :, 1])
        low = np.maximum(hung[one][:, None, 0], hung[other][None, :, 0])
        shared = (high - low).clip(0).prod(axis=2) / whole[one]
        shape = tuple(kinds if k in (one, other) else 1 for k in range(count))
        cost = cost + _OVERLAP * shared.reshape(shape)
    best = np.unravel_index(int(np.argmin(cost)), cost.shape)
    return [ANCHORS[each] for each in best]
