"""Occluders between camera and organ: instrument shafts, patches of fat, drapes.

They are assumed to be segmented out, so the organ has no return there; a segmentation that misses
one end of them leaves its points in. All is done in the image: pixels and the organ's own width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame

_SAMPLED = 200  # pixels that show where the organ lies
_STEEPEST = 0.6  # slope of what is left in: 30 degrees
_MOST_SHAFTS, _MOST_PATCHES = 2, 2
_CROSSES = 0.25  # share of shafts that cross the whole organ
_WIDER = 0.3  # a shaft that rises towards the camera looks wider by up to this an organ's width
_WAVES = 3
_PATCHES_ALONE, _SHAFTS_ALONE = 0.4, 0.2  # shares of images; the others have both
_BINS = 1024  # of the histogram in ``take_first``


class OcclusionConfig(Config, frozen=True, kw_only=True):
    """How much of the organ is hidden; zero ``scenes`` or ``largest_share`` switches it off.

    scenes: share of images with something before the organ.
    largest_share: of the visible pixels that are hidden there; each image draws its share
        uniformly up to it (shafts alone may hide less than drawn).
    left_in: of the hidden pixels, at most this share shows the occluder instead of nothing; each
        image draws its share uniformly up to it.
    shaft_mm: widths of shafts, at the organ's depth.
    nearer_mm: how much nearer than the organ, on the same line of sight, what is left in lies.
    """

    scenes: float = 0.0
    largest_share: float = 0.0
    left_in: float = 0.0
    shaft_mm: tuple[float, float] = (3.0, 12.0)
    nearer_mm: tuple[float, float] = (5.0, 40.0)

    def __post_init__(self) -> None:
        self.check_ranges("occlusion", scenes=1.0, largest_share=0.9, left_in=1.0)
        for name in ("shaft_mm", "nearer_mm"):
            low, high = getattr(self, name)
            if not 0 < low <= high < np.inf:
                raise InputError(
                    f"occlusion {name} is {low:g}..{high:g}; it must be a range of positive mm."
                )


@dataclass(frozen=True)
class _View:
    """The pixels with a return and what they see."""

    columns: Int32[np.ndarray, " n"]
    rows: Int32[np.ndarray, " n"]
    depth_mm: Float32[np.ndarray, " n"]
    some: Float[np.ndarray, "k 2"]  # (column, row) of a few
    width_px: float
    focal_px: float


def occlude(frame: DepthFrame, config: OcclusionConfig, rng: np.random.Generator) -> DepthFrame:
    """The frame without what lies behind shafts, patches, or both. Occlusion has random numbers of
    its own: ``rng`` is left as it was, and so is the rest of the scene."""
    if config.scenes == 0 or config.largest_share == 0:
        return frame
    rng = rng.spawn(1)[0]
    if rng.uniform() >= config.scenes:
        return frame
    seen = _look(frame, rng)
    most = int(rng.uniform(0, config.largest_share) * len(seen.depth_mm))
    if most == 0:
        return frame
    hidden = _hide(seen, most, config, rng)
    out_mm = frame.depth_mm.copy()
    out_mm[seen.rows[hidden], seen.columns[hidden]] = np.nan
    left = int(rng.uniform(0, config.left_in) * hidden.sum())
    if left:
        _leave_in(out_mm, seen, hidden, left, config, rng)
    return frame.with_depth(out_mm)


def _look(frame: DepthFrame, rng: np.random.Generator) -> _View:
    from tumortrack.core.depth_kernels import seen_pixels  # with SciPy, slow to import

    pixels, starts = seen_pixels(frame.depth_mm)
    rows = np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts))
    columns = pixels - rows * np.int32(frame.intrinsics.width)
    chosen = rng.integers(max(len(pixels), 1), size=_SAMPLED if len(pixels) else 0)
    some = np.stack([columns[chosen], rows[chosen]], axis=1).astype(float)
    width_px = float(np.ptp(some, axis=0).max(initial=1.0)) if len(some) else 1.0
    depth_mm = frame.depth_mm.ravel()[pixels]
    return _View(columns, rows, depth_mm, some, width_px, frame.intrinsics.fx)


def _hide(seen: _View, most: int, config: OcclusionConfig, rng: np.random.Generator) -> np.ndarray:
    """Which pixels are hidden: by shafts, patches, or shafts and patches."""
    hidden = np.zeros(len(seen.depth_mm), np.bool_)
    left, kind = most, rng.uniform()
    if kind > _PATCHES_ALONE:
        for _ in range(rng.integers(1, _MOST_SHAFTS + 1)):
            left -= take_first(_shaft(seen, config, rng), hidden, left)
    if kind < 1 - _SHAFTS_ALONE:
        for after in reversed(range(rng.integers(1, _MOST_PATCHES + 1))):
            count = left if after == 0 else int(rng.uniform() * left)
            left -= take_first(_patch(seen, rng), hidden, count)
    return hidden


def _shaft(seen: _View, config: OcclusionConfig, rng: np.random.Generator) -> np.ndarray:
    """A straight shaft from any side, its tip over a random pixel of the organ or beyond it."""
    at = rng.integers(len(seen.depth_mm))
    towards = _direction(rng)
    tip = np.array([seen.columns[at], seen.rows[at]], float)
    half = rng.uniform(*config.shaft_mm) / 2 * seen.focal_px / float(seen.depth_mm[at])
    taper = rng.uniform(0, _WIDER) * half / seen.width_px
    if rng.uniform() < _CROSSES:
        tip -= 2 * seen.width_px * towards
        taper /= 2
    return order_shaft(seen.columns, seen.rows, tip, towards, half, taper)


def _patch(seen: _View, rng: np.random.Generator) -> np.ndarray:
    """Fat or a drape: a blob or a half plane, from any border of the organ inwards."""
    inwards = _direction(rng)
    across = np.array([-inwards[1], inwards[0]])
    start = seen.some[np.argmin(seen.some @ inwards)] + rng.uniform(-0.1, 0.1, 2) * seen.width_px
    stretch = np.exp(rng.uniform(-0.7, 0.7))
    axes = np.stack([inwards * stretch, across / stretch]) / seen.width_px
    frequency = rng.uniform(3, 20, (2, _WAVES))  # rad an organ's width
    height = rng.uniform(0, 0.6, (2, _WAVES)) / frequency
    phase = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    waves = np.stack([frequency / seen.width_px, phase, height], axis=2)
    return order_patch(seen.columns, seen.rows, start, axes, bool(rng.integers(2)), waves)


def order_shaft(
    columns: Int32[np.ndarray, " n"],
    rows: Int32[np.ndarray, " n"],
    tip: Float[np.ndarray, " 2"],
    towards: Float[np.ndarray, " 2"],
    half: float,
    taper: float,
) -> Float32[np.ndarray, " n"]:
    """In what order pixels are hidden by a straight band that comes in against ``towards`` (unit
    vector, px) and ends round at ``tip`` (px), ``half`` wide there to either side and wider by
    ``taper`` a pixel outwards: what lies farthest out first, what lies outside infinite."""
    right, down = columns - tip[0], rows - tip[1]
    along = right * towards[0] + down * towards[1]
    across = np.abs(down * towards[0] - right * towards[1])
    round_tip = right * right + down * down < half * half
    inside = np.where(along >= 0, across < half + taper * along, round_tip)
    return np.where(inside, -along, np.inf).astype(np.float32)


def order_patch(
    columns: Int32[np.ndarray, " n"],
    rows: Int32[np.ndarray, " n"],
    start: Float[np.ndarray, " 2"],
    axes: Float[np.ndarray, "2 2"],
    blob: bool,
    waves: Float[np.ndarray, "2 k 3"],
) -> Float32[np.ndarray, " n"]:
    """The same for a patch with a wavy edge that grows from ``start`` (px): a blob with two lengths
    and directions, or a half plane along the first of the ``axes`` (1/px). ``waves``: frequency
    (rad/px), phase and height of the edge's waves along the columns and along the rows."""
    right, down = columns - start[0], rows - start[1]
    one, two = (right * a + down * b for a, b in axes)
    order = np.sqrt(one * one + two * two) if blob else one
    for places, of in zip((columns, rows), waves, strict=True):
        edge = np.zeros(places.max() + 1, np.float32)
        for frequency, phase, height in of:
            edge += height * np.cos(frequency * np.arange(len(edge)) + phase)
        order = order + edge[places]
    return order.astype(np.float32)


def take_first(order: Float[np.ndarray, " n"], taken: Bool[np.ndarray, " n"], count: int) -> int:
    """Mark in ``taken`` the ``count`` pixels of lowest ``order`` that are not taken yet, or a few
    less (whole bins of a histogram only); infinite ones never. Returns how many."""
    free = ~taken & (order < np.inf)
    if not free.any():
        return 0
    low, high = order[free].min(), order[free].max()
    bins = (order - low).astype(float) * ((_BINS - 1) / float(max(high - low, np.float32(1e-6))))
    if np.count_nonzero(free) > count:
        sizes = np.bincount(np.clip(bins[free], 0, _BINS - 1).astype(int))
        free &= bins < np.searchsorted(np.cumsum(sizes), count, side="right")
    taken |= free
    return int(np.count_nonzero(free))


def _leave_in(
    out_mm: np.ndarray,
    seen: _View,
    hidden: np.ndarray,
    count: int,
    config: OcclusionConfig,
    rng: np.random.Generator,
) -> None:
    """The occluder's own surface, a tilted plane, at one end of what it hides."""
    columns, rows, organ_mm = seen.columns[hidden], seen.rows[hidden], seen.depth_mm[hidden]
    shown = np.zeros(len(organ_mm), np.bool_)
    x, y = _direction(rng).astype(np.float32)
    take_first(columns * x + rows * y, shown, count)
    columns, rows, organ_mm = columns[shown], rows[shown], organ_mm[shown]
    if not len(rows):
        return
    (low, high), anchor = config.nearer_mm, rng.integers(len(rows))
    slope_x, slope_y = rng.uniform(-_STEEPEST, _STEEPEST, 2) / seen.focal_px
    rise = slope_x * (columns - columns[anchor]) + slope_y * (rows - rows[anchor])
    depth_mm = float(organ_mm[anchor]) - rng.uniform(low, high)
    own_mm = np.clip(depth_mm / np.maximum(1 - rise, 0.2), organ_mm - high, organ_mm - low)
    out_mm[rows, columns] = np.where(own_mm > 1.0, own_mm, np.nan)


def _direction(rng: np.random.Generator) -> Float[np.ndarray, " 2"]:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])
