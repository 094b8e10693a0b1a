"""Background that a depth image shows besides the organ: the table, tools, drapes.

A user's crop rarely removes all of it, so training shows some. Lengths are relative to the organ's
depths and width, so that background looks the same from near and far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tumortrack.core.config import Config
from tumortrack.core.types import DepthFrame

_STEEPEST = 0.6  # slope of a plane: 30 degrees
_SAMPLED = 400  # pixels that stand for the organ


class ClutterConfig(Config, frozen=True, kw_only=True):
    """``scenes``: share of images with background; ``largest_share``: its largest share of all
    points there, up to which each image draws uniformly. Zero switches it off."""

    scenes: float = 0.0
    largest_share: float = 0.0

    def __post_init__(self) -> None:
        self.check_ranges("clutter", scenes=1.0, largest_share=0.5)


@dataclass(frozen=True)
class _Organ:
    """Where the organ lies in the image."""

    middle_px: Float[np.ndarray, " 2"]  # (column, row)
    width_px: float
    width_mm: float
    near_mm: float
    far_mm: float


# A disc in the image: its middle and radius (px), and the depths (n,) at given offsets (n, 2) from
# the middle, in radii.
_Patch = tuple[Float[np.ndarray, " 2"], float, Float[np.ndarray, " n"]]


def add_clutter(frame: DepthFrame, config: ClutterConfig, rng: np.random.Generator) -> DepthFrame:
    """The frame with background in some of its pixels without return: a piece of a tilted plane
    behind the organ, a ball beside it, or points anywhere, equally likely. ``rng`` stays."""
    rng = rng.spawn(1)[0]
    if rng.uniform() >= config.scenes:
        return frame
    seen = np.flatnonzero(np.isfinite(frame.depth_mm))
    share = rng.uniform(0, config.largest_share)
    count = round(share / (1 - share) * len(seen))
    if count == 0:
        return frame
    organ = _organ(frame, seen, rng)
    radius = np.sqrt(rng.uniform(size=4 * count))  # most may hit the organ or miss the image
    angle = rng.uniform(0, 2 * np.pi, 4 * count)
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    make_patch = (_plane, _ball, _anywhere)[rng.integers(3)]
    middle_px, radius_px, patch_mm = make_patch(frame, organ, offsets, rng)
    column, row = np.rint(middle_px + offsets * radius_px).astype(int).T
    camera = frame.intrinsics
    free = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    free[free] &= np.isnan(frame.depth_mm[row[free], column[free]])
    free &= patch_mm > 1.0
    chosen = np.flatnonzero(free)[:count]
    depth_mm = frame.depth_mm.copy()
    depth_mm[row[chosen], column[chosen]] = patch_mm[chosen]
    return frame.with_depth(depth_mm)


def _organ(frame: DepthFrame, seen: np.ndarray, rng: np.random.Generator) -> _Organ:
    pixels = seen[rng.integers(len(seen), size=_SAMPLED)]
    row, column = np.divmod(pixels, frame.intrinsics.width)
    depth_mm = frame.depth_mm.flat[pixels]
    width_px = float(max(np.ptp(column), np.ptp(row), 1))
    return _Organ(
        np.array([column.mean(), row.mean()]),
        width_px,
        width_px * float(depth_mm.mean()) / frame.intrinsics.fx,
        float(depth_mm.min()),
        float(depth_mm.max()),
    )


def _plane(
    frame: DepthFrame, organ: _Organ, offsets: np.ndarray, rng: np.random.Generator
) -> _Patch:
    """Through a point behind the organ, tilted up to 30 degrees about two axes."""
    middle = organ.middle_px + rng.uniform(-0.5, 0.5, 2) * organ.width_px
    radius = rng.uniform(0.3, 1.0) * organ.width_px
    depth_mm = organ.far_mm + rng.uniform(-0.1, 0.4) * organ.width_mm
    slope = rng.uniform(-_STEEPEST, _STEEPEST, 2)
    tangents = offsets * (radius / frame.intrinsics.fx)
    return middle, radius, depth_mm / np.maximum(1 - tangents @ slope, 0.2)


def _ball(
    frame: DepthFrame, organ: _Organ, offsets: np.ndarray, rng: np.random.Generator
) -> _Patch:
    """Beside the organ, at its depths or a little behind; only its front is visible."""
    angle = rng.uniform(0, 2 * np.pi)
    apart = rng.uniform(0.4, 1.0) * organ.width_px
    middle = organ.middle_px + apart * np.array([np.cos(angle), np.sin(angle)])
    radius = rng.uniform(0.05, 0.3) * organ.width_px
    depth_mm = rng.uniform(organ.near_mm, organ.far_mm + 0.2 * organ.width_mm)
    radius_mm = radius * depth_mm / frame.intrinsics.fx
    bulge = np.sqrt(np.maximum(1 - (offsets**2).sum(1), 0.0))
    return middle, radius, depth_mm - radius_mm * bulge


def _anywhere(
    frame: DepthFrame, organ: _Organ, offsets: np.ndarray, rng: np.random.Generator
) -> _Patch:
    """Over the whole image, from in front of the organ to behind it."""
    size = np.array([frame.intrinsics.width, frame.intrinsics.height])
    low = organ.near_mm - 0.2 * organ.width_mm
    depth_mm = rng.uniform(low, organ.far_mm + 0.4 * organ.width_mm, len(offsets))
    return (size - 1) / 2, float(np.hypot(*size)) / 2, depth_mm
