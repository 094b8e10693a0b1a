"""From a whole depth image or cloud to the organ's points; one step, one file.

``organ_points`` runs the steps; ``picture`` has their switches, and what they work on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.sense.cloud import FEWEST_POINTS
from tumortrack.sense.region import picture as pictures
from tumortrack.sense.region.choose import take_one_piece
from tumortrack.sense.region.hints import Hints
from tumortrack.sense.region.picture import RegionConfig, keep_inside
from tumortrack.sense.region.pieces import remove_flying
from tumortrack.sense.region.plane import remove_plane
from tumortrack.sense.region.taught import colours_of
from tumortrack.sense.units import unit_advice

__all__ = ["Hints", "Region", "RegionConfig", "organ_points"]


@dataclass(frozen=True, eq=False)
class Region:
    """What is taken for the organ.

    Attributes:
        cloud: at most ``crop.n_points`` of its points, drawn at random; camera frame, mm.
        counts: pixels of the working picture by what became of them: ``organ``, ``no return``, or
            the step that took them (``region.picture.STEPS``).
        taken: (h, w) uint8, the same for each pixel of the working picture: numbers into
            ``STEPS``, 0 the organ. Of a cloud: as a camera at its origin sees it.
        seconds: time it took.
        doubt: why what clicks have taught could not be used, so that depth alone decided; or
            nothing.
    """

    cloud: SensorCloud
    counts: dict[str, int]
    taken: np.ndarray
    seconds: float
    doubt: str = ""


def organ_points(
    content: DepthFrame | SensorCloud, config: RegionConfig, hints: Hints, rng: np.random.Generator
) -> Region:
    """Crop by range, region of interest, mask and last estimate; remove what clicks have taught to
    be something else, the plane behind and flying points; take one piece, and what continues it
    behind something nearer.

    Of large images only every second (third ...) pixel is used. The same generator gives the same
    points.

    Raises:
        NoEstimate: fewer than 200 points are left; the message lists which step took how many.
        InputError: mask or picture is not of the image's size, or a mask was given with a cloud.
    """
    start = time.perf_counter()
    if isinstance(content, DepthFrame):
        picture = pictures.picture_of_frame(content, hints.mask)
    elif hints.mask is None:
        picture = pictures.picture_of_cloud(content)
    else:
        raise InputError("a mask goes with a depth image; for a cloud give box_mm instead.")
    depths_mm = [[-np.inf, -np.inf, config.crop.near_mm], [np.inf, np.inf, config.crop.far_mm]]
    keep_inside(picture, np.array(depths_mm), pictures.RANGE)
    if config.box_mm is not None:
        keep_inside(picture, np.array(config.box_mm), pictures.BOX)
    if hints.last_box_mm is not None and config.last_margin_mm > 0:
        margin_mm = config.last_margin_mm * np.array([[-1.0], [1.0]])
        keep_inside(picture, hints.last_box_mm + margin_mm, pictures.LAST_BOX)
    doubt = "" if hints.taught is None else _remove_taught(picture, content, hints)
    if config.plane:
        remove_plane(picture, config, rng)
    if config.flying:
        remove_flying(picture, config)
    if config.pieces:
        window, part = picture.cropped()
        take_one_piece(part, config, hints)
        picture.taken[window] = part.taken
    counts = picture.counts()
    left = picture.left(picture.taken)
    if len(left) < FEWEST_POINTS:
        took = ", ".join(f"{name} {n}" for name, n in counts.items() if n and name != "organ")
        near, far = config.crop.near_mm, config.crop.far_mm
        do = "move the camera until the organ is in view and in range, or say where it is"
        values: dict[str, float | str | None] = {
            "points": len(left),
            "fewest": FEWEST_POINTS,
            "pixels": picture.taken.size,
            "steps": took or "nothing",
            "near_mm": near,
            "far_mm": far,
            "advice": unit_advice(content, near, far) or do,
            "doubt": doubt and f" Also, {doubt}.",
        }
        raise NoEstimate(Finding("few_points", values))
    drawn = rng.choice(left, min(len(left), config.crop.n_points), replace=False)
    cloud = SensorCloud(picture.points(drawn), content.stamp_ns)
    return Region(cloud, counts, picture.taken, time.perf_counter() - start, doubt)


def _remove_taught(
    working: pictures.Picture, content: DepthFrame | SensorCloud, hints: Hints
) -> str:
    """Take what is plainly not the organ; or why that cannot be said of this frame."""
    seen = None
    if hints.picture is not None and isinstance(content, DepthFrame):
        seen = colours_of(content, hints.picture)
    assert hints.taught is not None
    try:
        working.take(hints.taught.beside(working, seen), pictures.COLOUR)
    except NoEstimate as error:
        return f"what the clicks taught is not used: {error}"
    return ""
