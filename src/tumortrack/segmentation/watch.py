"""Detect motion of the camera relative to the table, from the table's plane.

A plane shows three of six degrees of freedom: its distance and two tilts. A camera that slides
along the table or turns about its normal is not noticed, nor any motion without a table.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from jaxtyping import Float

from tumortrack.core.camera import deproject_pixels
from tumortrack.core.errors import NoEstimate
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.segmentation.plane import Plane, find_plane
from tumortrack.segmentation.working_image import RegionConfig, image_of_cloud, image_of_frame

_PIXELS = 1500  # sampled from an image; of a cloud as many cells
_PER_CELL = 6  # points of a cloud sampled for each cell
_EVERY, _SELDOM = 2, 30  # frames from one check to the next; while no table has been found
_MEDIAN_OF = 7  # checks, against noise and passing hands
_LEARNT_FROM = 15  # checks, whose median is the table at the start: a second at 30 Hz
# Without motion the median varies by up to 0.3 mm; the least shift that counts is
# well above that, and grows with the table's unevenness.
_SHIFT_MM, _SHIFT_SHARE = 1.0, 0.3
_CAPTURE_MM, _LEAST_MM = 6.0, 1.5  # tolerance of a shift's inliers, at first and at least
_FEWEST, _FEWEST_LARGE = 0.35, 0.6  # inliers over the table's points: of a small, of a large shift
_TRIES, _STAYS = 60, 0.15  # samples for a large shift; it leaves at most this share in place
_HIDDEN_CHECKS = 45  # 3 s at 30 Hz


class TableWatch:
    """Compares the table's plane, frame by frame, with that of the first frames, or with ``known``:
    unit normal and offset in mm, camera frame."""

    def __init__(
        self, config: RegionConfig, known: tuple[float, float, float, float] | None = None
    ) -> None:
        self._config, self._known = config, known
        self._first: list[tuple[Plane, np.ndarray]] = []  # with the points of that frame
        self._table: Plane | None = None
        self._offset_mm = np.zeros(3)  # of the first table from the known one, as ``_shifts``
        self._shifts: deque[np.ndarray] = deque(maxlen=_MEDIAN_OF)  # at three spots, mm
        self._frames = self._hidden = 0
        self._moved: Finding | None = None

    @property
    def table_in_camera(self) -> tuple[float, float, float, float] | None:
        """The first frames' table: normal and offset; None until it is known."""
        if self._table is None:
            return None
        x, y, z = self._table.normal.tolist()
        return x, y, z, self._table.offset

    @property
    def blind(self) -> bool:
        """Whether no table has been found so far, or in too few frames."""
        enough = _EVERY * _LEARNT_FROM * (2 if self._first else 1)
        return self._table is None and self._frames > enough

    def check(self, content: DepthFrame | SensorCloud) -> str:
        """A doubt about this frame, or an empty string. Raises NoEstimate, for this frame and all
        that follow, once camera or table have moved."""
        self._frames += 1
        every = _SELDOM if self.blind and not self._first else _EVERY
        if not self._moved and self._frames % every == 0:
            self._compare(content)
        if self._moved:
            raise NoEstimate(self._moved)
        if self._hidden > _HIDDEN_CHECKS:
            return "the table is hidden, so camera motion cannot be detected; uncover it"
        if self._known is not None and self._table is None:
            return "the calibration's table is not found: does the camera still stand there?"
        return ""

    def _compare(self, content: DepthFrame | SensorCloud) -> None:
        points_mm = _points(content)
        if self._table is None:
            self._learn(content, points_mm)
            return
        same_size = len(points_mm) == len(self._heights)
        shift = self._shift(points_mm) if same_size else None
        self._hidden = 0 if shift is not None else self._hidden + 1
        if shift is None:
            return
        self._shifts.append(shift + self._offset_mm)
        shifts = np.median(self._shifts, axis=0)
        least_mm = max(_SHIFT_MM, _SHIFT_SHARE * self._table.half_mm)
        if len(self._shifts) > _MEDIAN_OF // 2 and np.abs(shifts).max() > least_mm:
            slope = np.linalg.norm(shifts[1:] - shifts[0]) / self._reach_mm
            values: dict[str, float | str | None] = {
                "since": "the calibration" if self._known else "the start",
                "shift_mm": float(abs(shifts[0])),
                "degrees": float(np.degrees(np.arctan(slope))),
            }
            self._moved = Finding("moved", values)

    def _learn(self, content: DepthFrame | SensorCloud, points_mm: np.ndarray) -> None:
        if isinstance(content, DepthFrame):
            image = image_of_frame(content, None)
        else:
            image = image_of_cloud(content)
        plane = find_plane(image, self._config, np.random.default_rng(self._frames))
        if plane is None:
            return
        same_size = [first for first in self._first if first[1].shape == points_mm.shape]
        self._first = [*same_size, (plane, points_mm)]
        if len(self._first) < _LEARNT_FROM:
            return
        planes, points = zip(*self._first, strict=True)
        normal = np.median([plane.normal for plane in planes], axis=0)
        normal /= np.linalg.norm(normal)
        middle = np.median([plane.middle for plane in planes], axis=0)
        offset = float(np.median([normal @ plane.middle for plane in planes]))
        half_mm = float(np.median([plane.half_mm for plane in planes]))
        wide_mm = float(np.median([plane.wide_mm for plane in planes]))
        self._table, self._first = Plane(normal, offset, half_mm, middle, wide_mm), []
        heights = np.array(points) @ normal - offset
        often = np.isfinite(heights).sum(0) > _LEARNT_FROM // 2
        self._heights = np.full(len(points_mm), np.nan)
        self._heights[often] = np.nanmedian(heights[:, often], axis=0)
        self._heights[np.abs(self._heights) > half_mm] = np.nan  # of the table alone
        across = np.cross(normal, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        self._axes, self._reach_mm = np.stack([across, np.cross(normal, across)]), wide_mm / 2
        if self._known is not None:
            spots = middle + self._reach_mm * np.stack([0 * across, *self._axes])
            self._offset_mm = spots @ np.array(self._known[:3]) - self._known[3]

    def _shift(self, points_mm: np.ndarray) -> Float[np.ndarray, " 3"] | None:
        """How much nearer the table has come in its middle, and at two places half its width from
        there; None: too little of it is visible."""
        assert self._table is not None
        change = points_mm @ self._table.normal - self._table.offset - self._heights
        visible = np.isfinite(change)
        change, from_middle = change[visible], points_mm[visible] - self._table.middle
        slopes = from_middle @ self._axes.T / self._reach_mm
        design = np.column_stack([np.ones(len(slopes)), slopes])
        total = int(np.isfinite(self._heights).sum())
        fitted = _refined(design, change, np.zeros(3), _FEWEST * total)
        stays = np.count_nonzero(np.abs(change) < _LEAST_MM) > _STAYS * total
        if fitted is None and len(change) >= 3 and not stays:  # a large shift, or it is covered
            triples = np.random.default_rng(0).integers(len(change), size=(_TRIES, 3))
            start = np.linalg.pinv(design[triples]) @ change[triples][..., None]
            near = np.abs(design @ start[..., 0].T - change[:, None]) < _LEAST_MM
            best = int(near.sum(0).argmax())
            fitted = _refined(design, change, start[best, :, 0], _FEWEST_LARGE * total)
        return None if fitted is None else fitted + np.array([0, fitted[0], fitted[0]])


def _refined(
    design: np.ndarray, change: np.ndarray, fitted: np.ndarray, fewest: float
) -> np.ndarray | None:
    """Least squares over inliers, with a tolerance that shrinks; None if they are too few."""
    within_mm = _CAPTURE_MM
    for _ in range(5):
        residuals = np.abs(change - design @ fitted)
        near = residuals < within_mm
        if np.count_nonzero(near) < max(fewest, 50):
            return None
        fitted = np.linalg.lstsq(design[near], change[near], rcond=None)[0]
        within_mm = float(np.clip(4.5 * np.median(residuals[near]), _LEAST_MM, _CAPTURE_MM))
    return fitted


def _points(content: DepthFrame | SensorCloud) -> Float[np.ndarray, "n 3"]:
    """The points of the same, evenly spread pixels each time, NaN without a return; of a cloud one
    for each cell of an image that a camera at its origin would take."""
    if isinstance(content, SensorCloud):
        side = int(np.sqrt(_PIXELS))
        sampled = content.points_mm[:: max(1, len(content.points_mm) // (_PER_CELL * _PIXELS))]
        sampled = sampled[sampled[:, 2] > 1].astype(np.float64)
        cells = np.floor((sampled[:, :2] / sampled[:, 2:] + 1) * (side / 2)).astype(int)
        inside = ((cells >= 0) & (cells < side)).all(1)
        points_mm = np.full((side * side, 3), np.nan)
        points_mm[cells[inside] @ [side, 1]] = sampled[inside]
        return points_mm
    depth_mm, camera = content.depth_mm, content.intrinsics
    step = max(1, int(np.sqrt(depth_mm.size / _PIXELS)))
    rows, columns = np.mgrid[step // 2 : len(depth_mm) : step, step // 2 : depth_mm.shape[1] : step]
    index = (rows * depth_mm.shape[1] + columns).ravel()
    return deproject_pixels(index, depth_mm.ravel()[index].astype(np.float64), camera).astype(float)
