"""What a tracked ultrasound probe recorded: borders of parts in its images, and its poses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Outline
from tumortrack.core.geometry import Affine, Points, rigid, transform_points

# Places on one border that are nearer err alike: a reader's drawing is smooth over so much.
APART_MM = 3.0
PIXEL_MM = 0.005, 5.0  # a pixel's side, at least and at most
_MOST_PLANES = 150  # of a fit, evenly in time: more cost time and hardly tell more
_SMOOTH_S = 0.25  # shorter than what a hand does with a probe
_LONGEST_GAP_S = 0.5  # between poses; between farther ones a hand may have turned back


class ImageErrors(NamedTuple):
    """What is wrong in all images of a recording alike. ``lag_s``: by which their stamps are late:
    an image of time t shows what was before the probe at t - lag. ``depth``, ``width``: by which
    a length along the beam and across it is longer than the pixels say, as a share: with another
    speed of sound than the scanner presumes."""

    lag_s: float = 0.0
    depth: float = 0.0
    width: float = 0.0


NO_ERRORS = ImageErrors()


@dataclass(frozen=True, eq=False)
class ProbeRecording:
    """Places on the borders of parts, in pixels of the images, and where the probe was.

    Attributes:
        tool: the probe's name.
        frame: of the poses.
        stamps_s: of the poses, rising.
        frame_from_probe: poses, mm.
        probe_from_image: (column, row, 0) -> mm; a pixel's centre is a whole number.
        parts: names.
        places_px: column, row; sorted by plane.
        part: of each place, the number of its part.
        plane: of each place, the number of its image.
        image_stamps_s: of each place, its image's.
        std_mm: of each place.
        shared_std_mm: of a shift of all places alike, as by a calibration.
        camera_from_frame: to the frame of the answer.
        notes: on what was left out in reading.
    """

    tool: str
    frame: str
    stamps_s: Float64[np.ndarray, " m"]
    frame_from_probe: Float64[np.ndarray, "m 4 4"]
    probe_from_image: Affine
    parts: tuple[str, ...]
    places_px: Float64[np.ndarray, "n 2"]
    part: Int64[np.ndarray, " n"]
    plane: Int64[np.ndarray, " n"]
    image_stamps_s: Float64[np.ndarray, " n"]
    std_mm: float = 1.0
    shared_std_mm: float = 0.0
    camera_from_frame: Affine = field(default_factory=lambda: np.eye(4))
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.stamps_s) < 2 or not (np.diff(self.stamps_s) > 0).all():
            raise InputError(f"{self.tool}: there must be two poses or more, with rising stamps.")

    def places_mm(self, errors: ImageErrors = NO_ERRORS) -> Points:
        """Of all places in the frame of the answer; NaN where no pose is known."""
        scales = 1 + np.array([errors.width, errors.depth])
        in_image = np.column_stack([self.places_px * scales, np.zeros(len(self.places_px))])
        in_probe = transform_points(self.probe_from_image, in_image)
        stamps_s, plane = np.unique(self.image_stamps_s, return_inverse=True)
        stamps_s, known = stamps_s - errors.lag_s, self.stamps_s
        after = np.clip(np.searchsorted(known, stamps_s), 1, len(known) - 1)
        gap_s = known[after] - known[after - 1]
        near = (gap_s <= _LONGEST_GAP_S) | np.isin(stamps_s, known)
        inside = (stamps_s >= known[0]) & (stamps_s <= known[-1]) & near
        from scipy.spatial.transform import Rotation, Slerp  # slow to import

        at_s = np.clip(stamps_s, known[0], known[-1])
        turns = Slerp(known, Rotation.from_matrix(self.frame_from_probe[:, :3, :3]))(at_s)
        shifts, share = (
            self.frame_from_probe[:, :3, 3],
            ((at_s - known[after - 1]) / gap_s)[:, None],
        )
        moved = (1 - share) * shifts[after - 1] + share * shifts[after]
        moved[~inside] = np.nan
        places_mm = np.einsum("nij,nj->ni", turns.as_matrix()[plane], in_probe) + moved[plane]
        return transform_points(self.camera_from_frame, places_mm)

    @property
    def known_mm(self) -> Points:
        """The places as recorded, where a pose is known."""
        places_mm = self.places_mm()
        return places_mm[np.isfinite(places_mm).all(1)]

    def moved(self, by_mm: Float64[np.ndarray, " 3"]) -> ProbeRecording:
        """In a frame whose origin lies elsewhere."""
        return replace(self, camera_from_frame=rigid(np.eye(3), by_mm) @ self.camera_from_frame)

    def outlines(self, errors: ImageErrors = NO_ERRORS) -> tuple[Outline, ...]:
        """One of each part in each plane."""
        places_mm = self.places_mm(errors)
        known = np.isfinite(places_mm).all(1)
        found = []
        for number in np.unique(self.plane[known]):
            for part in np.unique(self.part[mine := known & (self.plane == number)]):
                some = places_mm[mine & (self.part == part)]
                found.append(
                    Outline(
                        places_mm=tuple(map(tuple, some.tolist())),
                        part=self.parts[part],
                        std_mm=self.std_mm,
                        shared_std_mm=self.shared_std_mm,
                        tool=self.tool,
                    )
                )
        return tuple(found)

    def smoothed(self) -> ProbeRecording:
        """With poses averaged over ``_SMOOTH_S``: what a tracker's noise adds would pull a lag to
        the middle between two poses, where interpolation lessens it."""
        from scipy.ndimage import uniform_filter1d

        many = round(_SMOOTH_S / float(np.median(np.diff(self.stamps_s))))
        size = min(2 * (many // 2) + 1, len(self.stamps_s))
        rows = np.column_stack([self.stamps_s, self.frame_from_probe.reshape(-1, 16)])
        means = uniform_filter1d(rows, size, axis=0, mode="nearest")
        poses = means[:, 1:].reshape(-1, 4, 4)
        left, _, right = np.linalg.svd(poses[:, :3, :3])
        poses[:, :3, :3] = left @ right
        return replace(self, stamps_s=means[:, 0], frame_from_probe=poses)

    def thinned(self, most: int) -> ProbeRecording:
        """At most so many places, evenly over time and along the borders."""
        planes = np.unique(self.plane)
        count = min(len(planes), _MOST_PLANES, most)
        chosen = planes[np.unique(np.linspace(0, len(planes) - 1, count).round().astype(int))]
        each, keep = max(most // len(chosen), 1), np.zeros(len(self.plane), bool)
        for number in chosen:
            mine = np.flatnonzero(self.plane == number)
            some = np.linspace(0, len(mine) - 1, min(len(mine), each)).round().astype(int)
            keep[mine[np.unique(some)]] = True
        return replace(
            self,
            places_px=self.places_px[keep],
            part=self.part[keep],
            plane=self.plane[keep],
            image_stamps_s=self.image_stamps_s[keep],
        )


def border_px(
    inside: Bool[np.ndarray, "h w"], field: Bool[np.ndarray, "h w"] | None = None
) -> Float64[np.ndarray, "n 2"]:
    """Where a part's region ends in an image: (column, row) halfway between two pixels. It does not
    end where the image does, nor at the edge of the ``field`` that the probe sees."""
    across, down = inside[:, 1:] != inside[:, :-1], inside[1:] != inside[:-1]
    if field is not None:
        across &= field[:, 1:] & field[:, :-1]
        down &= field[1:] & field[:-1]
    # Many times as fast as np.nonzero of two axes.
    rows, columns = np.divmod(np.flatnonzero(across), max(across.shape[1], 1))
    lower_rows, lower_columns = np.divmod(np.flatnonzero(down), max(down.shape[1], 1))
    return np.concatenate(
        [
            np.column_stack([columns + 0.5, rows]),
            np.column_stack([lower_columns, lower_rows + 0.5]),
        ]
    )


def spread_px(
    places_px: Float64[np.ndarray, "n 2"], mm_per_pixel: tuple[float, float]
) -> Float64[np.ndarray, "m 2"]:
    """One place for each ``APART_MM``: that nearest to the mean of those about it."""
    if not len(places_px):
        return places_px
    cells = np.floor(places_px * mm_per_pixel / APART_MM).astype(int)
    across, down = (cells - cells.min(0)).T
    cell = across * (down.max() + 1) + down
    count = np.maximum(np.bincount(cell), 1)
    means = np.column_stack([np.bincount(cell, places_px[:, k]) / count for k in (0, 1)])
    away = ((places_px - means[cell]) ** 2).sum(1)
    order = np.lexsort([away, cell])
    return places_px[order[np.r_[True, np.diff(cell[order]) > 0]]]


def part_borders_px(
    labels: UInt8[np.ndarray, "h w"],
    parts: dict[int, str],
    mm_per_pixel: tuple[float, float],
    field: Bool[np.ndarray, "h w"] | None = None,
) -> dict[str, Float64[np.ndarray, "n 2"]]:
    """Of an image of labels, by part: the ``parts`` of the labels that are there. The organ, the
    part of label 1, is what any label covers: a tumor's border inside it is none of the organ's."""
    found = {}
    for label, name in sorted(parts.items()):
        same = labels == label
        if same.any() and len(places := border_px(labels > 0 if label == 1 else same, field)):
            found[name] = spread_px(places, mm_per_pixel)
    return found
