"""The organ by colour and depth together, as a few clicks teach it.

Each click shows what a patch of a few millimetres looks like. A place is of the kind of the click
that it resembles most, and of neither where it resembles none, so that what nobody clicked on is
left to geometry: a nearest mean with one covariance, the mean of the patches' own, and so much
besides as light, noise and mottles may change. All of it in blocks of 2 x 2 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame
from tumortrack.sense.region.picture import ORGAN, Picture, picture_of_frame, some_pixels

# Standard deviations of what one kind of tissue may differ by, besides what its patches show: two
# of colour (red and blue less green, over their sum, which shading and exposure leave alone), the
# logarithm of the brightness against the scene's median, unevenness (over the brightness), and mm
# before what is round it: a finger lies on an organ, fat does not.
_STD = np.array([0.025, 0.025, 0.6, 0.1, 8.0])
_OFFSET = 9.0  # of the sum of three grey levels: keeps the noise of dark pixels small
_DARK, _BRIGHT = 16, 250  # beyond, a pixel has no colour: a shadow, a highlight
_SPOT_MM, _SHINES = 7.0, 1.3  # a highlight is smaller, and so much brighter than what is round it
_FINE_MM, _FILL_MM, _ROUND_MM = 1.0, 4.0, 15.0  # blur of colour; across highlights; of depth
_PATCH_MM, _FEWEST = 3.0, 12  # radius of a patch, blocks in it
_SPECK_MM2 = 60.0  # smaller are a highlight's rim, a vessel: no thing beside the organ
_KNOWN = 5.0**2  # squared distance (Mahalanobis) beyond which a block is like no click
_CLEAR = 4.0  # of a block's log odds: one that is surer counts no more among its neighbours
_EACH = 2  # clicks of each kind: what one shows is held against the other
_RIGHT, _APART = 0.8, 1.75  # of a click's pixels, judged by the others; of two kinds of clicks
_SEEN, _LEAST_MM2 = 0.2, 300.0  # must resemble a click; the organ: else the light is another one

Colours = UInt8[np.ndarray, "h w *rgb"]


@dataclass(frozen=True, eq=False)
class Click:
    """What is seen round a place that is the organ's, or is not: a row for each block."""

    organ: bool
    features: Float32[np.ndarray, "n 5"]


@dataclass(frozen=True, eq=False)
class Taught:
    """What clicks have taught. ``centres``: of each click, whitened by ``whiten``; ``organ``: which
    of them are the organ's; ``right``: share of pixels that the other clicks judge rightly."""

    centres: Float32[np.ndarray, "k 5"]
    organ: Bool[np.ndarray, " k"]
    whiten: Float32[np.ndarray, "5 5"]
    right: float

    def beside(self, working: Picture, colours: Colours | None) -> Bool[np.ndarray, "h w"]:
        """Which pixels of the working picture are plainly not the organ's. ``colours``: of these
        pixels. Raises NoEstimate, with the reason: there are none, or hardly anything in them
        resembles a click."""
        if colours is None:
            raise NoEstimate(Finding("no_picture"))
        features, usable = _features(working, colours)
        height, width = usable.shape
        looked_at = working.taken[: 2 * height : 2, : 2 * width : 2] == ORGAN
        usable &= looked_at
        odds, known = np.zeros(usable.shape, np.float32), np.zeros(usable.shape, np.float32)
        odds[usable], known[usable] = self.log_odds(features[usable])
        block_mm = 2 * working.pixel_mm
        likely_mm2 = np.count_nonzero(odds > 0) * block_mm**2
        if known.sum() < _SEEN * np.count_nonzero(looked_at) or likely_mm2 < _LEAST_MM2:
            raise NoEstimate(Finding("no_organ_colour"))
        # What has no colour, as highlights, is of the kind of what is round it.
        fine, wide = (_mean([odds], known, mm / block_mm)[0] for mm in (_FINE_MM, _FILL_MM))
        beside = np.zeros(working.taken.shape, bool)
        blocks = _large(np.where(usable, fine, wide) < 0, _SPECK_MM2 / block_mm**2)
        beside[: 2 * height, : 2 * width] = blocks.repeat(2, axis=0).repeat(2, axis=1)
        return beside

    def log_odds(
        self, features: Float32[np.ndarray, "n 5"]
    ) -> tuple[Float32[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """That a block is the organ's rather than not, cut off where it is clear, 0 where it
        resembles no click; and whether it resembles one."""
        white = features @ self.whiten
        apart = (white**2).sum(1)[:, None] + (self.centres**2).sum(1) - 2 * white @ self.centres.T
        own, other = apart[:, self.organ].min(1), apart[:, ~self.organ].min(1)
        known = np.minimum(own, other) < _KNOWN
        return np.clip((other - own) / 2, -_CLEAR, _CLEAR) * known, known


def colours_of(frame: DepthFrame, picture: Colours) -> Colours:
    """The pixels of a picture that are looked at. InputError: it is not of the frame's size."""
    if picture.shape[:2] != frame.depth_mm.shape:
        (height, width), camera = picture.shape[:2], frame.intrinsics
        raise InputError(
            f"the picture is {width} x {height}, the depth image {camera.width} x {camera.height}; "
            "give a picture of the depth image's pixels."
        )
    return picture[some_pixels(frame)]


def look(frame: DepthFrame, picture: Colours, pixel: tuple[int, int], organ: bool) -> Click:
    """What a click on this pixel (row, column) of a depth image and its picture shows. Raises
    InputError: too little is seen there, or the picture is of another size."""
    working, step = picture_of_frame(frame, None), 2 * some_pixels(frame)[0].step
    features, usable = _features(working, colours_of(frame, picture))
    height, width = usable.shape
    z, (fx, fy, cx, cy) = working.depth_mm[: 2 * height : 2, : 2 * width : 2], working.pinhole
    rows, columns = 2 * np.indices(z.shape)
    points_mm = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=-1)
    at = tuple(min(max(n, 0) // step, m - 1) for n, m in zip(pixel, z.shape, strict=True))
    reach_mm = max(_PATCH_MM, 5 * working.footprint * float(z[at]))
    near = usable & (((points_mm - points_mm[at]) ** 2).sum(-1) < reach_mm**2)
    if np.count_nonzero(near) < _FEWEST:
        raise InputError(
            "too little is seen there: it has no depth, or is too dark, white with light, or thin. "
            "Click elsewhere."
        )
    return Click(organ, features[near])


def teach(clicks: Sequence[Click]) -> Taught:
    """In any order. Raises InputError, with the reason: too few clicks of a kind, or those of one
    look like those of the other."""
    clicks = sorted(clicks, key=lambda one: (one.organ, *one.features.mean(0, dtype=float)))
    organ = np.array([one.organ for one in clicks], bool)
    counts = {"the organ": organ.sum(), "not the organ": (~organ).sum()}
    missing = [f"{_EACH - n} more on what is {kind}" for kind, n in counts.items() if n < _EACH]
    if missing:
        raise InputError(f"click {' and '.join(missing)}")
    right = np.array([_right(clicks[:k] + clicks[k + 1 :], clicks[k]) for k in range(len(clicks))])
    taught, worst = (
        _fitted(clicks, float(right.mean())),
        min(right[organ].mean(), right[~organ].mean()),
    )
    own, other = taught.centres[organ], taught.centres[~organ]
    apart = float(np.linalg.norm(own[:, None] - other, axis=2).min())
    if worst < _RIGHT or apart < _APART:
        raise InputError(
            f"what is the organ and what is not look alike: judged by the other clicks "
            f"{100 * worst:.0f} % of a click are right ({100 * _RIGHT:.0f} % are needed), the "
            f"nearest two are {apart:.1f} standard deviations apart ({_APART:g}). Click on more "
            "places, or leave it to depth"
        )
    return taught


def _right(others: list[Click], one: Click) -> float:
    """The share of a click that the other clicks do not take for the other kind."""
    odds, _ = _fitted(others, 0.0).log_odds(one.features)
    return float((odds >= 0).mean() if one.organ else (odds <= 0).mean())


def _fitted(clicks: list[Click], right: float) -> Taught:
    centres = np.array([one.features.mean(0, dtype=float) for one in clicks])
    within = np.mean([np.cov(one.features.astype(float), rowvar=False) for one in clicks], axis=0)
    whiten = np.linalg.cholesky(np.linalg.inv(within + np.diag(_STD**2)))
    organ = np.array([one.organ for one in clicks], bool)
    return Taught((centres @ whiten).astype(np.float32), organ, whiten.astype(np.float32), right)


def _features(
    working: Picture, colours: Colours
) -> tuple[Float32[np.ndarray, "y x 5"], Bool[np.ndarray, "y x"]]:
    """Of each block, see ``_STD``; and which blocks have both colour and depth."""
    from scipy.ndimage import grey_opening

    block_mm = 2 * working.pixel_mm
    (red, green, blue, square), lit = _blocks(colours)
    bright = red + green + blue
    window = 2 * round(_SPOT_MM / 2 / block_mm) + 1
    lit[bright > _SHINES * grey_opening(bright, (window, window)) + 3 * _DARK] = 0
    depth_mm = working.depth_mm[: 2 * len(lit) : 2, : 2 * lit.shape[1] : 2]
    there = np.isfinite(depth_mm)
    usable = (lit > 0) & there
    middle = np.median(bright[usable]) if usable.any() else 0.0
    (round_mm,) = _mean([np.nan_to_num(depth_mm)], there.astype(np.float32), _ROUND_MM / block_mm)
    red, green, blue, square = _mean([red, green, blue, square], lit, _FINE_MM / block_mm)
    bright = red + green + blue
    total = bright + _OFFSET
    features = [
        *((red - green) / total, (blue - green) / total, np.log(total / (middle + _OFFSET))),
        *(np.sqrt(np.maximum(square - bright**2, 0)) / total, round_mm - depth_mm),
    ]
    return np.stack(features, axis=-1).astype(np.float32), usable


def _blocks(
    colours: Colours,
) -> tuple[Float32[np.ndarray, "4 y x"], Float32[np.ndarray, "y x"]]:
    """Of each block, of those pixels that have a colour: means of red, green, blue and squared
    brightness, 0 for none; and how many they are."""
    height, width = (n // 2 for n in colours.shape[:2])
    sums, lit = np.zeros((4, height, width), np.float32), np.zeros((height, width), np.float32)
    for corner in np.ndindex(2, 2):
        own = colours[corner[0] : 2 * height : 2, corner[1] : 2 * width : 2]
        channels = np.moveaxis(own, 2, 0) if own.ndim == 3 else np.stack([own] * 3)
        red, green, blue = channels.astype(np.float32)
        most, least = (
            np.maximum(np.maximum(red, green), blue),
            np.minimum(np.minimum(red, green), blue),
        )
        has = ((most >= _DARK) & (least < _BRIGHT)).astype(np.float32)
        for total, one in zip(sums, (red, green, blue, (red + green + blue) ** 2), strict=True):
            total += one * has
        lit += has
    return sums / np.maximum(lit, 1), lit


def _mean(
    values: Sequence[np.ndarray], weights: Float32[np.ndarray, "h w"], radius: float
) -> list[Float32[np.ndarray, "h w"]]:
    """Weighted means over squares of that radius, but at least a block; 0 where all weights are."""
    from scipy.ndimage import uniform_filter

    size = 2 * max(1, round(radius)) + 1
    total = np.maximum(uniform_filter(weights, size, mode="constant"), 1e-5)
    return [uniform_filter(one * weights, size, mode="constant") / total for one in values]


def _large(where: Bool[np.ndarray, "h w"], least: float) -> Bool[np.ndarray, "h w"]:
    """Its connected pieces of more than ``least`` pixels."""
    from scipy.ndimage import label

    pieces, _ = label(where)
    large = np.bincount(pieces.ravel()) > least
    large[0] = False
    return large[pieces]
