"""From a whole depth image or cloud to the organ's points; one step, one file.

``organ_points`` runs the steps; ``working_image`` has what they work on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from tumortrack.core.cloud import FEWEST_POINTS
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.core.units import unit_advice
from tumortrack.segmentation.choose import choose_pieces
from tumortrack.segmentation.measured_noise import DepthNoise, image_noise
from tumortrack.segmentation.pieces import remove_flying
from tumortrack.segmentation.plane import remove_plane
from tumortrack.segmentation.tissue import Hints, colours_of
from tumortrack.segmentation.working_image import (
    BOX,
    COLOUR,
    LAST_BOX,
    ORGAN,
    PIECES,
    RANGE,
    RegionConfig,
    WorkingImage,
    image_of_cloud,
    image_of_frame,
    keep_inside,
)
from tumortrack.simulation.noise import REFERENCE_MM

__all__ = ["Hints", "Region", "RegionConfig", "organ_points"]

_OTHER_DEPTH = 1.15  # times: noise that grows with its square is another by a third
_MOST_CANDIDATES = 3000  # points beside the organ's: an organ of which a quarter was found


@dataclass(frozen=True, eq=False)
class Region:
    """What is taken for the organ.

    Attributes:
        cloud: at most ``crop.n_points`` of its points, drawn at random; camera frame, mm.
        counts: number of working-image pixels that are ``organ``, had ``no return``, or were
            removed by each step (``working_image.STEPS``).
        pixel_class: (h, w) uint8, the same for each pixel of the working image: index into
            ``STEPS``, 0 the organ. Of a cloud as seen by a camera at its origin.
        seconds: run time.
        doubt: why the colours learnt from clicks were not used, so that depth alone decided; or
            empty.
        noise: of the depth image, as measured, if it shows a surface.
    """

    cloud: SensorCloud
    counts: dict[str, int]
    pixel_class: np.ndarray
    seconds: float
    doubt: str = ""
    noise: DepthNoise | None = None


def organ_points(
    content: DepthFrame | SensorCloud, config: RegionConfig, hints: Hints, rng: np.random.Generator
) -> Region:
    """Crop by range, region of interest, mask and last estimate; remove other tissue by colour, the
    background plane and flying pixels; choose one connected piece.

    Of large images only every second (third ...) pixel is used. The same generator gives the same
    points.

    Raises:
        NoEstimate: fewer than 200 points remain; the message says how many each step removed.
        InputError: mask or picture is not of the image's size, or a mask was given with a cloud.
    """
    start = time.perf_counter()
    image, noise, config = _image_of(content, config, hints)
    near, far = config.crop.near_mm, config.crop.far_mm
    keep_inside(image, np.array([[-np.inf, -np.inf, near], [np.inf, np.inf, far]]), RANGE)
    if config.box_mm is not None:
        keep_inside(image, np.array(config.box_mm), BOX)
    if hints.last_box_mm is not None and config.last_margin_mm > 0:
        margin_mm = config.last_margin_mm * np.array([[-1.0], [1.0]])
        keep_inside(image, hints.last_box_mm + margin_mm, LAST_BOX)
    doubt = _remove_other_tissue(image, content, hints)
    if config.plane:
        remove_plane(image, config, rng)
    if config.flying:
        remove_flying(image, config)
    possible = image.remaining(image.pixel_class)
    others: list[np.ndarray] = []
    if config.pieces:
        window, part = image.cropped()
        others = [_pixels_of(image, window, mask) for mask in choose_pieces(part, config, hints)]
        image.pixel_class[window] = part.pixel_class
    counts = image.counts()
    remaining = image.remaining(image.pixel_class)
    if noise is not None and hints.noise is None and isinstance(content, DepthFrame):
        noise = _noise_there(content, image, remaining, noise)
    if len(remaining) < FEWEST_POINTS:
        steps = ", ".join(f"{name} {n}" for name, n in counts.items() if n and name != "organ")
        advice = "move the camera until the organ is in view and in range, or say where it is"
        values: dict[str, float | str | None] = {
            "points": len(remaining),
            "fewest": FEWEST_POINTS,
            "pixels": image.pixel_class.size,
            "steps": steps or "nothing",
            "near_mm": near,
            "far_mm": far,
            "advice": unit_advice(content, near, far) or advice,
            "doubt": doubt and f" Also, {doubt}.",
        }
        raise NoEstimate(Finding("few_points", values))

    def cloud_of(pixels: np.ndarray) -> SensorCloud:
        drawn = rng.choice(pixels, min(len(pixels), config.crop.n_points), replace=False)
        beside = possible[np.isin(possible, pixels, assume_unique=True, invert=True)]
        most = min(round(len(beside) * len(drawn) / len(pixels)), _MOST_CANDIDATES)
        beside = rng.choice(beside, most, replace=False)
        count = len(pixels) * image.step_px**2
        return SensorCloud(
            image.points(drawn),
            content.stamp_ns,
            None if noise is None else noise.of_points(count, image.window_px),
            image.points(beside),
            content.depth_error,
        )

    cloud = cloud_of(remaining)
    more = [cloud_of(pixels) for pixels in others if len(pixels) >= FEWEST_POINTS]
    cloud = replace(cloud, others=tuple(more))
    return Region(cloud, counts, image.pixel_class, time.perf_counter() - start, doubt, noise)


def _image_of(
    content: DepthFrame | SensorCloud, config: RegionConfig, hints: Hints
) -> tuple[WorkingImage, DepthNoise | None, RegionConfig]:
    """What the steps work on, the noise of a depth image, and the configuration with it."""
    if isinstance(content, SensorCloud):
        if hints.mask is not None:
            raise InputError("a mask goes with a depth image; for a cloud give box_mm instead.")
        return image_of_cloud(content), None, config
    noise = hints.noise or _noise_in_reach(content, config, hints)
    image = image_of_frame(content, hints.mask, noise)
    if noise is not None:
        config = _as_noisy(config, noise, image.window_px)
    return image, noise, config


def _noise_in_reach(frame: DepthFrame, config: RegionConfig, hints: Hints) -> DepthNoise | None:
    """Measured where the organ can be; if nothing there is smooth, in the whole image."""
    near_mm, far_mm = config.crop.near_mm, config.crop.far_mm
    boxes = [(config.box_mm, 0.0), (hints.last_box_mm, config.last_margin_mm)]
    for corners, margin_mm in ((np.array(box), more) for box, more in boxes if box is not None):
        near_mm = max(near_mm, float(corners[:, 2].min()) - margin_mm)
        far_mm = min(far_mm, float(corners[:, 2].max()) + margin_mm)
    there = (frame.depth_mm > near_mm) & (frame.depth_mm < far_mm)
    if hints.mask is not None and hints.mask.shape == there.shape:
        there &= hints.mask
    return _noise_where(frame, there) or image_noise(frame)


def _noise_there(
    frame: DepthFrame, image: WorkingImage, organ: np.ndarray, noise: DepthNoise
) -> DepthNoise:
    """The noise; measured once more, on the organ, if that lies at another depth: how noise grows
    with depth differs from camera to camera."""
    if not len(organ):
        return noise
    times = float(np.median(image.depth_mm.ravel()[organ])) / noise.depth_mm
    if 1 / _OTHER_DEPTH < times < _OTHER_DEPTH:
        return noise
    rows, columns = np.divmod(organ, image.depth_mm.shape[1])
    (height, width), step = frame.depth_mm.shape, image.step_px
    there = np.zeros((height, width), bool)
    for down in range(step):
        for right in range(step):
            row = np.minimum(rows * step + down, height - 1)
            there[row, np.minimum(columns * step + right, width - 1)] = True
    return _noise_where(frame, there) or noise


def _noise_where(frame: DepthFrame, there: np.ndarray) -> DepthNoise | None:
    return image_noise(frame.with_depth(np.where(there, frame.depth_mm, np.float32(np.nan))))


def _pixels_of(image: WorkingImage, window: Any, mask: np.ndarray) -> np.ndarray:
    """Of a piece in a window of the image, as ``WorkingImage.remaining`` has them."""
    pixel_class = np.full_like(image.pixel_class, PIECES)
    pixel_class[window] = np.where(mask, ORGAN, PIECES)
    return image.remaining(pixel_class)


def _as_noisy(config: RegionConfig, noise: DepthNoise, window_px: int) -> RegionConfig:
    """With the noise that is left, if it is more than was presumed."""
    left_mm = noise.of_points(1, window_px).point_mm * (REFERENCE_MM / noise.depth_mm) ** 2
    return msgspec.structs.replace(config, noise_mm=max(config.noise_mm, min(left_mm, 10.0)))


def _remove_other_tissue(
    image: WorkingImage, content: DepthFrame | SensorCloud, hints: Hints
) -> str:
    """Remove what the colours learnt from clicks rule out. Returns why they can't be used on this
    frame, or an empty string."""
    if hints.tissue_classifier is None:
        return ""
    colours = None
    if hints.picture is not None and isinstance(content, DepthFrame):
        colours = colours_of(content, hints.picture)
    try:
        image.remove(hints.tissue_classifier.other_tissue(image, colours), COLOUR)
    except NoEstimate as error:
        return f"the classifier trained by the clicks is not used: {error}"
    return ""
