"""Tell the organ from other tissue by colour and depth, learnt from a few clicks.

A nearest-mean classifier: each click gives the mean of a patch of a few millimetres. All share one
covariance, the mean of the patches' own plus what light, noise and mottling may change. A place far
from every mean is of no class and left to geometry. It works on blocks of 2 x 2 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame
from tumortrack.segmentation.measured_noise import DepthNoise
from tumortrack.segmentation.working_image import (
    ORGAN,
    WorkingImage,
    image_of_frame,
    sampled_pixels,
)

# Standard deviation of each feature within one kind of tissue, in addition to that within patches:
# two of colour (red and blue minus green, over the sum, which cancels shading and exposure), log of
# the brightness over the scene's median, unevenness over the brightness, and mm in front of the
# surroundings: a finger lies on an organ, fat does not.
_STD = np.array([0.025, 0.025, 0.6, 0.1, 8.0])
_OFFSET = 9.0  # added to the sum of three grey levels, against the noise of dark pixels
_DARK, _BRIGHT = 16, 250  # outside these a pixel has no colour: a shadow, a highlight
_SPOT_MM, _SHINES = 7.0, 1.3  # a highlight's largest size, and its brightness over its surroundings
_FINE_MM, _FILL_MM, _ROUND_MM = 1.0, 4.0, 15.0  # blur of colour; across highlights; of depth
_PATCH_MM, _FEWEST = 3.0, 12  # radius of a patch; fewest blocks in it
_SPECK_MM2 = 60.0  # smaller areas are a highlight's rim or a vessel, not other tissue
_KNOWN = 5.0**2  # squared Mahalanobis distance beyond which a block resembles no click
_CLEAR = 4.0  # largest log odds with which a block counts among its neighbours
_EACH = 2  # fewest clicks of each kind: each is tested against the others
_RIGHT, _APART = 0.8, 1.75  # least share of a click classified correctly; least distance of kinds
# Least share of blocks that resemble a click, and least area of the organ; else the light changed.
_RESEMBLING, _LEAST_MM2 = 0.2, 300.0

Colours = UInt8[np.ndarray, "h w *rgb"]


@dataclass(frozen=True, eq=False)
class Click:
    """The features around a place on the organ, or on other tissue: a row for each block."""

    organ: bool
    features: Float32[np.ndarray, "n 5"]


@dataclass(frozen=True, eq=False)
class TissueClassifier:
    """``centres``: mean of each click's features, whitened by ``whiten``; ``organ``: which of them
    are the organ's; ``right``: share of pixels classified correctly, cross-validated by click."""

    centres: Float32[np.ndarray, "k 5"]
    organ: Bool[np.ndarray, " k"]
    whiten: Float32[np.ndarray, "5 5"]
    right: float

    def other_tissue(self, image: WorkingImage, colours: Colours | None) -> Bool[np.ndarray, "h w"]:
        """Pixels of the working image, with these ``colours``, that are clearly not the organ's.
        Raises NoEstimate: there are no colours, or hardly anything resembles a click."""
        if colours is None:
            raise NoEstimate(Finding("no_picture"))
        features, usable = _features(image, colours)
        height, width = usable.shape
        remaining = image.pixel_class[: 2 * height : 2, : 2 * width : 2] == ORGAN
        usable &= remaining
        odds, known = np.zeros(usable.shape, np.float32), np.zeros(usable.shape, np.float32)
        odds[usable], known[usable] = self.log_odds(features[usable])
        block_mm = 2 * image.pixel_mm
        organ_mm2 = np.count_nonzero(odds > 0) * block_mm**2
        if known.sum() < _RESEMBLING * np.count_nonzero(remaining) or organ_mm2 < _LEAST_MM2:
            raise NoEstimate(Finding("no_organ_colour"))
        # What has no colour, such as highlights, takes the class of its surroundings.
        fine, wide = (_mean([odds], known, mm / block_mm)[0] for mm in (_FINE_MM, _FILL_MM))
        other = np.zeros(image.pixel_class.shape, bool)
        blocks = _large(np.where(usable, fine, wide) < 0, _SPECK_MM2 / block_mm**2)
        other[: 2 * height, : 2 * width] = blocks.repeat(2, axis=0).repeat(2, axis=1)
        return other

    def log_odds(
        self, features: Float32[np.ndarray, "n 5"]
    ) -> tuple[Float32[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Log odds that a block is the organ's, clipped, 0 where it resembles no click; and whether
        it resembles one."""
        white = features @ self.whiten
        apart = (white**2).sum(1)[:, None] + (self.centres**2).sum(1) - 2 * white @ self.centres.T
        own, other = apart[:, self.organ].min(1), apart[:, ~self.organ].min(1)
        known = np.minimum(own, other) < _KNOWN
        return np.clip((other - own) / 2, -_CLEAR, _CLEAR) * known, known


@dataclass(frozen=True, eq=False)
class Hints:
    """What is known about a frame besides its depth.

    Attributes:
        mask: of a depth image's pixels, True where the organ may be.
        picked_mm: a point on the organ, camera frame; selects the piece. Organs move: once there is
            an estimate, give its box instead.
        last_box_mm: lower and upper corner of the last estimate's organ, camera frame.
        picture: colour or grey image in the depth image's pixels, for ``tissue_classifier``.
        tissue_classifier: tells the organ from other tissue by colour. None: only geometry counts.
        noise: of this camera, as an earlier frame showed it; None: it is measured.
    """

    mask: Bool[np.ndarray, "h w"] | None = None
    picked_mm: Float[np.ndarray, " 3"] | None = None
    last_box_mm: Float[np.ndarray, "2 3"] | None = None
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None
    tissue_classifier: TissueClassifier | None = None
    noise: DepthNoise | None = None


def colours_of(frame: DepthFrame, picture: Colours) -> Colours:
    """The working image's pixels of a picture. Raises InputError: it is not of the frame's size."""
    if picture.shape[:2] != frame.depth_mm.shape:
        (height, width), camera = picture.shape[:2], frame.intrinsics
        raise InputError(
            f"the picture is {width} x {height}, the depth image {camera.width} x {camera.height}; "
            "give a picture of the depth image's pixels."
        )
    return picture[sampled_pixels(frame)]


def sample_click(frame: DepthFrame, picture: Colours, pixel: tuple[int, int], organ: bool) -> Click:
    """The features around a pixel (row, column) of a depth image and its picture. Raises
    InputError: too few of them, or a picture of another size."""
    image, step = image_of_frame(frame, None), 2 * sampled_pixels(frame)[0].step
    features, usable = _features(image, colours_of(frame, picture))
    height, width = usable.shape
    z, (fx, fy, cx, cy) = image.depth_mm[: 2 * height : 2, : 2 * width : 2], image.pinhole
    rows, columns = 2 * np.indices(z.shape)
    points_mm = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=-1)
    at = tuple(min(max(n, 0) // step, m - 1) for n, m in zip(pixel, z.shape, strict=True))
    reach_mm = max(_PATCH_MM, 5 * image.footprint * float(z[at]))
    near = usable & (((points_mm - points_mm[at]) ** 2).sum(-1) < reach_mm**2)
    if np.count_nonzero(near) < _FEWEST:
        raise InputError(
            "too little is seen there: it has no depth, or is too dark, white with light, or thin. "
            "Click elsewhere."
        )
    return Click(organ, features[near])


def train_tissue_classifier(clicks: Sequence[Click]) -> TissueClassifier:
    """The classifier that clicks, in any order, give. Raises InputError: too few clicks of a kind,
    or kinds that look alike."""
    clicks = sorted(clicks, key=lambda click: (click.organ, *click.features.mean(0, dtype=float)))
    organ = np.array([click.organ for click in clicks], bool)
    counts = {"the organ": organ.sum(), "not the organ": (~organ).sum()}
    missing = [f"{_EACH - n} more on what is {kind}" for kind, n in counts.items() if n < _EACH]
    if missing:
        raise InputError(f"click {' and '.join(missing)}")
    right = np.array([_right(clicks[:k] + clicks[k + 1 :], clicks[k]) for k in range(len(clicks))])
    worst = min(right[organ].mean(), right[~organ].mean())
    classifier = _fitted(clicks, float(right.mean()))
    own, other = classifier.centres[organ], classifier.centres[~organ]
    apart = float(np.linalg.norm(own[:, None] - other, axis=2).min())
    if worst < _RIGHT or apart < _APART:
        raise InputError(
            f"what is the organ and what is not look alike: judged by the other clicks "
            f"{100 * worst:.0f} % of a click are right ({100 * _RIGHT:.0f} % are needed), the "
            f"nearest two are {apart:.1f} standard deviations apart ({_APART:g}). Click on more "
            "places, or leave it to depth"
        )
    return classifier


def _right(others: list[Click], click: Click) -> float:
    """The share of a click that the other clicks do not assign to the wrong kind."""
    odds, _ = _fitted(others, 0.0).log_odds(click.features)
    return float((odds >= 0).mean() if click.organ else (odds <= 0).mean())


def _fitted(clicks: list[Click], right: float) -> TissueClassifier:
    features = [click.features.astype(float) for click in clicks]
    centres = np.array([click.features.mean(0, dtype=float) for click in clicks])
    within = np.mean([np.cov(rows, rowvar=False) for rows in features], axis=0)
    whiten = np.linalg.cholesky(np.linalg.inv(within + np.diag(_STD**2)))
    organ = np.array([click.organ for click in clicks], bool)
    centres = (centres @ whiten).astype(np.float32)
    return TissueClassifier(centres, organ, whiten.astype(np.float32), right)


def _features(
    image: WorkingImage, colours: Colours
) -> tuple[Float32[np.ndarray, "y x 5"], Bool[np.ndarray, "y x"]]:
    """The features of each block (see ``_STD``), and which blocks have both colour and depth."""
    from scipy.ndimage import grey_opening

    block_mm = 2 * image.pixel_mm
    (red, green, blue, square), lit = _blocks(colours)
    bright = red + green + blue
    window = 2 * round(_SPOT_MM / 2 / block_mm) + 1
    lit[bright > _SHINES * grey_opening(bright, (window, window)) + 3 * _DARK] = 0
    depth_mm = image.depth_mm[: 2 * len(lit) : 2, : 2 * lit.shape[1] : 2]
    valid = np.isfinite(depth_mm)
    usable = (lit > 0) & valid
    middle = np.median(bright[usable]) if usable.any() else 0.0
    (around_mm,) = _mean([np.nan_to_num(depth_mm)], valid.astype(np.float32), _ROUND_MM / block_mm)
    red, green, blue, square = _mean([red, green, blue, square], lit, _FINE_MM / block_mm)
    bright = red + green + blue
    total = bright + _OFFSET
    features = [
        *((red - green) / total, (blue - green) / total, np.log(total / (middle + _OFFSET))),
        *(np.sqrt(np.maximum(square - bright**2, 0)) / total, around_mm - depth_mm),
    ]
    return np.stack(features, axis=-1).astype(np.float32), usable


def _blocks(
    colours: Colours,
) -> tuple[Float32[np.ndarray, "4 y x"], Float32[np.ndarray, "y x"]]:
    """Means of red, green, blue and squared brightness over each block's pixels that have a colour,
    0 without any; and the number of these pixels."""
    height, width = (n // 2 for n in colours.shape[:2])
    sums, lit = np.zeros((4, height, width), np.float32), np.zeros((height, width), np.float32)
    for corner in np.ndindex(2, 2):
        part = colours[corner[0] : 2 * height : 2, corner[1] : 2 * width : 2]
        channels = np.moveaxis(part, 2, 0) if part.ndim == 3 else np.stack([part] * 3)
        red, green, blue = channels.astype(np.float32)
        most = np.maximum(np.maximum(red, green), blue)
        least = np.minimum(np.minimum(red, green), blue)
        coloured = ((most >= _DARK) & (least < _BRIGHT)).astype(np.float32)
        for total, values in zip(sums, (red, green, blue, (red + green + blue) ** 2), strict=True):
            total += values * coloured
        lit += coloured
    return sums / np.maximum(lit, 1), lit


def _mean(
    values: Sequence[np.ndarray], weights: Float32[np.ndarray, "h w"], radius: float
) -> list[Float32[np.ndarray, "h w"]]:
    """Weighted means over squares of a radius in blocks, at least one; 0 where all weights are."""
    from scipy.ndimage import uniform_filter

    size = 2 * max(1, round(radius)) + 1
    total = np.maximum(uniform_filter(weights, size, mode="constant"), 1e-5)
    return [uniform_filter(layer * weights, size, mode="constant") / total for layer in values]


def _large(where: Bool[np.ndarray, "h w"], least: float) -> Bool[np.ndarray, "h w"]:
    """The connected pieces of more than ``least`` pixels."""
    from scipy.ndimage import label

    pieces, _ = label(where)
    large = np.bincount(pieces.ravel()) > least
    large[0] = False
    return large[pieces]
