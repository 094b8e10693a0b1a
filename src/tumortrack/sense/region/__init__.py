"""From a whole depth image or cloud to the organ's points; one step, one file.

``organ_points`` runs the steps, ``config`` has their switches, ``picture`` what they work on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.sense.cloud import FEWEST_POINTS
from tumortrack.sense.region import choose
from tumortrack.sense.region import picture as pictures
from tumortrack.sense.region.choose import Choice, Sizes
from tumortrack.sense.region.config import RegionConfig
from tumortrack.sense.region.picture import Picture, keep_inside
from tumortrack.sense.region.pieces import find_edges, find_pieces, remove_flying
from tumortrack.sense.region.plane import remove_plane

__all__ = ["Hints", "Region", "RegionConfig", "organ_points"]

_OPENINGS = (1.0, 1.7, 2.8)  # times ``opening_mm``: the last is wider than fingers
_CLEARLY = 1.1  # better by so much is worth a wider opening


@dataclass(frozen=True, eq=False)
class Hints:
    """What is known about a frame besides its depth.

    Attributes:
        mask: of a depth image's pixels, True where the organ may be.
        picked_mm: a point on the organ, camera frame, as a user clicked it. It decides which piece
            is taken. Organs move: once there is an estimate, give its box instead.
        last_box_mm: lower and upper corner of the last estimate's organ, camera frame.
    """

    mask: Bool[np.ndarray, "h w"] | None = None
    picked_mm: Float[np.ndarray, " 3"] | None = None
    last_box_mm: Float[np.ndarray, "2 3"] | None = None


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
    """

    cloud: SensorCloud
    counts: dict[str, int]
    taken: np.ndarray
    seconds: float


def organ_points(
    content: DepthFrame | SensorCloud, config: RegionConfig, hints: Hints, rng: np.random.Generator
) -> Region:
    """Crop by range, region of interest, mask and last estimate; remove the plane behind and
    flying points; take one piece, and what continues it behind something nearer.

    Of large images only every second (third ...) pixel is used. The same generator gives the same
    points.

    Raises:
        NoEstimate: fewer than 200 points are left; the message lists which step took how many.
        InputError: the mask is not of the image's size, or was given with a cloud.
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
    if config.plane:
        remove_plane(picture, config, rng)
    if config.flying:
        remove_flying(picture, config)
    if config.pieces:
        window = picture.remaining()
        part = picture.part(window)
        _take_one_piece(part, config, hints)
        picture.taken[window] = part.taken
    counts = picture.counts()
    left = picture.left(picture.taken)
    if len(left) < FEWEST_POINTS:
        raise NoEstimate(_too_few(len(left), counts, config))
    drawn = rng.choice(left, min(len(left), config.crop.n_points), replace=False)
    cloud = SensorCloud(picture.points(drawn), content.stamp_ns)
    return Region(cloud, counts, picture.taken, time.perf_counter() - start)


def _take_one_piece(picture: Picture, config: RegionConfig, hints: Hints) -> None:
    """Leave one piece (and what continues it) to the organ.

    A hand that touches the organ makes one large piece with it that leaves the picture. Then the
    opening is widened until fingers are too narrow to connect.
    """
    edges = find_edges(picture, config)
    best: Choice | None = None
    for wider in _OPENINGS:
        pieces, count = find_pieces(picture, edges, wider * config.opening_mm)
        sizes = choose.sizes(picture, edges, pieces, count)
        chosen = _chosen(picture, pieces, sizes, config, hints)
        here = choose.choice(picture, pieces, sizes, chosen, config)
        if best is None or here.score > _CLEARLY * best.score:
            best = here
        if not here.doubtful:
            break
    assert best is not None
    picture.take(best.pieces == 0, pictures.THIN)
    together = best.together
    if hints.last_box_mm is not None and together.any():
        together = together | choose.parts_of(picture, best, hints.last_box_mm)
    picture.take(~together[best.pieces], pictures.PIECES)


def _chosen(
    picture: Picture, pieces: np.ndarray, sizes: Sizes, config: RegionConfig, hints: Hints
) -> tuple[int | None, bool]:
    """The piece that the hints name, else the likeliest; and whether it is only the likeliest."""
    if hints.picked_mm is not None:
        return choose.under_point(picture, pieces, hints.picked_mm), False
    if hints.last_box_mm is not None:
        piece = choose.under_box(picture, pieces, sizes, hints.last_box_mm)
        if piece is not None:
            return piece, False
    return choose.likeliest(sizes, config), True


def _too_few(left: int, counts: dict[str, int], config: RegionConfig) -> str:
    took = ", ".join(f"{name} {n}" for name, n in counts.items() if n and name != "organ")
    return (
        f"only {left} points are left for the organ; at least {FEWEST_POINTS} are needed. Of "
        f"{sum(counts.values())} pixels went to: {took or 'nothing'} (range "
        f"{config.crop.near_mm:g}..{config.crop.far_mm:g} mm). Move the camera, widen what took "
        "most, or switch that step off."
    )
