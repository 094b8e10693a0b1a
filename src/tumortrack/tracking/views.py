"""The views that `locate` reads, the poses of their cameras, and the organ in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from tumortrack.core.camera import deproject_pixels, with_depth_error
from tumortrack.core.cloud import check_cloud, check_depth_unit, crop_cloud
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Affine
from tumortrack.core.store import read_json
from tumortrack.core.types import DepthFrame, PointNoise, SensorCloud, View
from tumortrack.io.depth_files import (
    CLOUD_SUFFIXES,
    DEPTH_SUFFIXES,
    read_cloud,
    read_depth,
    read_mask,
    read_poses,
)
from tumortrack.registration.base_model import Model
from tumortrack.registration.gauss_newton import FARTHEST
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion, seen_from_first
from tumortrack.registration.multi_view import kernel_width_mm, lies_on
from tumortrack.segmentation import Hints, organ_points
from tumortrack.segmentation.measured_noise import noise_of
from tumortrack.segmentation.working_image import ORGAN, PIECES, STEPS, THIN, image_of_frame
from tumortrack.tracking.options import LocateOptions

NO_CLOUD = Path("-")
_NEAR = 3  # pixels from the one of --at


@dataclass(frozen=True, eq=False)
class ViewFile:
    """The content of an input file of `locate`. ``unit``: of a depth image, mm per step and where
    that is stated; ``notes``: on what was dropped."""

    path: Path
    content: SensorCloud | DepthFrame
    notes: tuple[str, ...] = ()
    unit: tuple[float, str] | None = None

    def hints(self, at: tuple[int, int] | None, mask: Path | None) -> Hints:
        """From a pixel on the organ, and an image that is 0 outside it. Raises InputError: no such
        pixel, no return there, no such image, or this is a cloud."""
        if at is None and mask is None:
            return Hints()
        if isinstance(self.content, SensorCloud):
            raise InputError(f"--at and --mask are for depth images; {self.path} is a cloud.")
        camera = self.content.intrinsics
        inside = None if mask is None else read_mask(mask, (camera.width, camera.height))
        return Hints(inside, None if at is None else _picked_mm(self.content, *at))

    def organ(self, model: Model, options: LocateOptions, hints: Hints) -> OrganInView:
        """The organ as it was found before anything was fitted. A cloud is taken for the organ
        alone, unless a box is given.

        Raises NoEstimate: nothing can be the organ; InputError: the depth's unit cannot be right.
        """
        if isinstance(self.content, SensorCloud) and options.box is None:
            return OrganInView(*self._cropped(self.content, options.range))
        given = {
            "--box": options.box,
            f"--at {' '.join(map(str, options.at or ()))}": options.at,
            f"--mask {options.mask}": options.mask,
            "--whole": options.whole,
        }
        hint = " and ".join(name for name, value in given.items() if value)
        hint = hint or "shape, size and place alone"
        region, words = options.region(model), f"{self.path.name}: "
        entry: dict[str, Any] = {"file": self.path.name, "hint": hint}
        if self.unit is not None and isinstance(self.content, DepthFrame):
            unit_mm, stated_by = self.unit
            check_depth_unit(self.content, unit_mm, region.crop.near_mm, region.crop.far_mm)
            entry["depth_unit_mm"] = unit_mm
            unit = "in metres" if unit_mm == 1000 else f"in steps of {unit_mm:g} mm"
            words += f"depth {unit} ({stated_by}); "
        found = organ_points(self.content, region, hints, np.random.default_rng(options.seed))
        depth = isinstance(self.content, DepthFrame)
        noise = found.noise if depth else noise_of(self.content)
        entry |= {} if noise is None else {"noise": noise.entry}
        last = "" if noise is None else f"; {noise.message}"
        return OrganInView(found.cloud, entry, found.pixel_class, (words, last)).with_pixels(
            found.pixel_class
        )

    def fitted(
        self, found: OrganInView, motion: ElasticMotion, within_mm: float, piece: int
    ) -> OrganInView:
        """The organ in a depth image once it is fitted, in the ``piece`` of that number: other
        pieces that lie on it are its own."""
        if piece:
            found = found._replace(cloud=found.cloud.others[piece - 1])
        if found.pixel_class is None or not isinstance(self.content, DepthFrame):
            return found
        pixel_class = found.pixel_class.copy()
        if piece:
            pixel_class[pixel_class == ORGAN] = PIECES
        beside = np.flatnonzero(np.isin(pixel_class, (THIN, PIECES)))
        points_mm = image_of_frame(self.content, None).points(beside)
        pixel_class.ravel()[beside[lies_on(motion, points_mm, within_mm)]] = ORGAN
        return found.with_pixels(pixel_class)

    def _cropped(
        self, cloud: SensorCloud, range_mm: tuple[float, float] | None
    ) -> tuple[SensorCloud, dict[str, Any]]:
        count, hint = len(cloud.points_mm), "--range" if range_mm else ""
        if self.path == NO_CLOUD:
            words = "no cloud: the organ was touched or outlined alone."
            return cloud, {"file": "", "hint": "touches", "organ": 0, "of": 0, "message": words}
        if range_mm:
            cloud = crop_cloud(cloud, *range_mm)
        kept = len(cloud.points_mm)
        words = f"{self.path.name}: {kept} of {count} points were taken for the organ"
        words += f", by {hint}." if hint else ": a cloud is taken for the organ alone."
        entry = {"file": self.path.name, "hint": hint, "organ": kept, "of": count}
        return cloud, {**entry, **_with_noise(cloud, words)}


class OrganInView(NamedTuple):
    """The organ's points; an entry for the report on how they were chosen, with a sentence for
    people as ``words``; and the class of each pixel (``segmentation.Region``). ``around``: how that
    sentence begins and ends."""

    cloud: SensorCloud
    entry: dict[str, Any]
    pixel_class: UInt8[np.ndarray, "h w"] | None = None
    around: tuple[str, str] = ("", "")

    def with_pixels(self, pixel_class: UInt8[np.ndarray, "h w"]) -> OrganInView:
        numbers = np.bincount(pixel_class.ravel(), minlength=len(STEPS)).tolist()
        counts = {name: n for name, n in zip(STEPS, numbers, strict=True) if n}
        returns = sum(n for name, n in counts.items() if name != "no return")
        others = ", ".join(f"{name} {n}" for name, n in counts.items()
                           if name not in ("organ", "no return"))  # fmt: skip
        organ = counts.get("organ", 0)
        words = f"{organ} of {returns} pixels with a return were taken for the organ, by "
        words += f"{self.entry['hint']}{f' (others: {others})' if others else ''}"
        entry = {"organ": organ, "of": returns, "pixels": counts}
        entry["message"] = f"{self.around[0]}{words}{self.around[1]}."
        return self._replace(pixel_class=pixel_class, entry={**self.entry, **entry})


def _with_noise(content: DepthFrame | SensorCloud, words: str) -> dict[str, Any]:
    """The words, and the noise that was measured, as entries."""
    if (noise := noise_of(content)) is None:
        return {"message": words}
    return {"noise": noise.entry, "message": f"{words.removesuffix('.')}; {noise.message}."}


def read_views(paths: Sequence[Path], options: LocateOptions) -> list[ViewFile]:
    """Read clouds, or depth images with their intrinsics. Raises InputError: one cannot be read, or
    an option is for the other kind."""
    cameras: tuple[Path | None, ...] = options.intrinsics or (None,)
    count = len(paths)
    if len(cameras) not in (1, count):
        raise InputError(
            f"--intrinsics is given {len(cameras)} times for {count} view{'s' * (count > 1)}: give "
            "it once, or once for each."
        )
    cameras = cameras if len(cameras) == count else cameras * count
    stated = options.stated_error
    views = [_read_view(*pair, options) for pair in zip(paths, cameras, strict=True)]
    if stated is None:
        return views
    return [replace(view, content=with_depth_error(view.content, stated)) for view in views]


def _read_view(path: Path, intrinsics: Path | None, options: LocateOptions) -> ViewFile:
    if path == NO_CLOUD:
        if not options.evidence:
            raise InputError("without a cloud (-) give --evidence FILE with touches or outlines.")
        return ViewFile(path, SensorCloud(np.zeros((0, 3), np.float32)))
    suffix = path.suffix.lower()
    if suffix in DEPTH_SUFFIXES and (suffix not in CLOUD_SUFFIXES or intrinsics is not None):
        if intrinsics is None:
            raise InputError(f"{path} is a depth image: give --intrinsics FILE.json with it.")
        if options.unit != "mm":
            raise InputError("--unit is for clouds; of a depth image give --depth-unit.")
        frame, unit_mm = read_depth(path, intrinsics, options.depth_unit)
        stated_by = "--depth-unit"
        if options.depth_unit is None:
            in_file = "depth_unit_mm" in read_json(intrinsics)
            stated_by = f"stated in {intrinsics.name}" if in_file else "the default"
        return ViewFile(path, frame, unit=(unit_mm, stated_by))
    if suffix in CLOUD_SUFFIXES and (intrinsics is not None or options.depth_unit is not None):
        option = "--intrinsics" if intrinsics is not None else "--depth-unit"
        raise InputError(f"{option} is for depth images; {path} is a cloud.")
    cloud, notes = read_cloud(path, options.unit)
    check_cloud(cloud)  # before the crop, which would only say that nothing lies in range
    return ViewFile(path, cloud, notes)


def read_places(poses: Path | None, views: int) -> tuple[str, tuple[Affine, ...]]:
    """The fixed frame's name, and fixed_from_camera of each view; empty for a single view, whose
    table of poses is of a probe."""
    if views == 1 and (poses is None or poses.suffix.lower() == ".csv"):
        return "", ()
    if poses is None or views == 1:
        raise InputError("give --poses FILE with several views, and only with several.")
    return read_poses(poses, views)


def further_views(
    organs: Sequence[SensorCloud], views: Sequence[ViewFile], fixed_from_camera: Sequence[Affine]
) -> list[View]:
    """All views but the first, in whose frame the estimate is."""
    return [
        View(organ, view.content, np.linalg.inv(fixed_from_camera[0]) @ pose)
        for organ, view, pose in list(zip(organs, views, fixed_from_camera, strict=False))[1:]
    ]


def _picked_mm(frame: DepthFrame, column: int, row: int) -> Float[np.ndarray, " 3"]:
    """The surface point at a pixel, or at the nearest one with a return. Raises InputError: no such
    pixel, or no return near it."""
    camera = frame.intrinsics
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        size = f"{camera.width} x {camera.height}"
        raise InputError(f"--at {column} {row} is outside the depth image of {size} pixels.")
    left, top = max(0, column - _NEAR), max(0, row - _NEAR)
    near = frame.depth_mm[top : row + _NEAR + 1, left : column + _NEAR + 1]
    pixels = np.argwhere(np.isfinite(near.T)) + [left, top]
    if not len(pixels):
        raise InputError(f"--at {column} {row} has no return. Give another pixel.")
    x, y = pixels[np.square(pixels - [column, row]).sum(1).argmin()]
    depth_mm = frame.depth_mm[y, [x]].astype(float)
    return deproject_pixels(np.array([y * camera.width + x]), depth_mm, camera)[0].astype(float)


def as_fitted(
    views: Sequence[ViewFile], found: Sequence[OrganInView], estimate: Estimate, model: Model
) -> list[OrganInView]:
    """The organ in each view, by an estimate in the frame of the first."""
    motion, corrected = estimate.motion, estimate.report.views
    if not isinstance(motion, ElasticMotion) or not isinstance(model, RegistrationModel):
        return list(found)
    refine = model.config.refine
    ways = (
        [np.eye(4)]
        if corrected is None
        else [np.array(pose) for pose in corrected.camera_from_view]
    )
    out: list[OrganInView] = []
    for view, organ, way in zip(views, found, ways, strict=True):
        width_mm = kernel_width_mm(refine, organ.cloud.noise or PointNoise())
        there = seen_from_first(motion, np.linalg.inv(way))
        piece = 0 if out else estimate.report.piece  # further views have their most likely one
        out.append(view.fitted(organ, there, FARTHEST * width_mm, piece))
    return out
