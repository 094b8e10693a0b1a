"""A model on clouds: `locate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import (
    Device,
    console,
    keep_loaded,
    model_folder,
    say,
    say_json,
    say_notes,
)
from tumortrack.cli.finding import FindingOrgan
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate

if TYPE_CHECKING:
    import numpy as np

    from tumortrack.cli.views import View
    from tumortrack.core.estimate import Estimate
    from tumortrack.core.geometry import Affine
    from tumortrack.core.types import Anatomy, DepthFrame, Look, SensorCloud
    from tumortrack.live.viewer.slices import CarriedCt
    from tumortrack.models.model import Model
    from tumortrack.sense.region import Hints
    from tumortrack.tracking.points import PointTable

# Exit statuses; what cannot be used is 2.
VERDICTS = {"good": 0, "poor": 4, "none": NoEstimate.exit_code}
_ASK = "say where the organ is: --at COLUMN ROW, --box or --mask"


@dataclass(frozen=True, kw_only=True)
class Locate(FindingOrgan):
    """Locate organ and tumors in one cloud or depth image, or in several of the organ at rest.

    In a depth image the organ is found among table, drapes, instruments and hands, as `track` does
    it; a cloud is taken for the organ alone, unless --box is given. OUT/index.html shows the
    answer. Exit status: 0 good; 4 poor (all is written); 3 no estimate (OUT says why); 2 an error.

    Attributes:
        model: a case, or a folder that `train` wrote.
        cloud: .ply, .pcd or .npz in the camera frame, or a depth image (with --intrinsics): 16-bit
            PNG or TIFF, or a TIFF of floats. Several views of an organ that does not move in
            between (CLOUD CLOUD ... OUT) need --poses; the answer is in the first one's frame.
        out: folder to write.
        more: with several views: the paths that follow; the last one is OUT.
        poses: JSON with fixed_from_camera (4 x 4 rows for each view, in their order), unit (mm or
            m) and frame_id: where the camera was, in a robot's base, say.
        at: COLUMN ROW of a pixel of the depth image that shows the organ, from 0 at the upper left.
        mask: image of the depth image's size, 0 where the organ is not.
        grid: voxels along the longest side of the labelled volume, up to 400.
        seed: of the random points and queries.
        unit: of a cloud's numbers.
        depth_unit: of a depth image: mm a step. Default: what the intrinsics file says
            (depth_unit_mm), else 0.1 (a D405's), of floats 1000 (metres). Many cameras have 1.
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels: once for all views, or again
            and again, once for each in their order.
        map: points of the CT whose present places to write (OUT/points.csv): a .csv with columns
            x,y,z (LPS, mm), or 3D Slicer's .mrk.json or .fcsv. Needs a model of preset clinic.
        case: the model's case, whose CT the page's slices then show where it lies now (preset
            clinic); a second or two longer.
        device: auto takes CUDA if there is a GPU.
        json: print the report (OUT/report.json); sentences go to standard error.
        overwrite: replace OUT if it exists.
    """

    model: Positional[Path]
    cloud: Positional[Path]
    out: Positional[Path]
    more: Positional[tuple[Path, ...]] = ()
    poses: Path | None = None
    at: tuple[int, int] | None = None
    mask: Path | None = None
    grid: int = 160
    seed: int = 0
    unit: Literal["mm", "m"] = "mm"
    depth_unit: float | None = None
    intrinsics: UseAppendAction[tuple[Path, ...]] = ()
    map: Path | None = None
    case: Path | None = None
    device: Device = "auto"
    json: bool = False
    overwrite: bool = False

    def run(self) -> int:
        """Its exit status, by the verdict."""
        from tumortrack.tracking.files import has_no_estimate

        check_grid(self.grid)
        console.stderr = self.json
        paths = [self.cloud, self.out, *self.more]
        clouds, out = paths[:-1], paths[-1]
        if self.model.is_file() and (self.cloud / store.MANIFEST).is_file():
            raise InputError(
                f"{self.model} stands where the model belongs, and {self.cloud} where the cloud. "
                f"The order is: tumortrack locate {self.cloud} {self.model} {self.out}"
            )
        overwrite = self.overwrite or has_no_estimate(out)
        store.check_place(out, "run", overwrite)
        folder = model_folder(self.model)
        points = self._points(folder)
        frame_id, fixed_from_camera = self._poses(len(clouds))
        views = self._views(clouds)
        hints = views[0].hints(self.at, self.mask)

        from tumortrack.report.seen import PAGE, Seen
        from tumortrack.tracking.model_files import load_model
        from tumortrack.tracking.tracker import Tracker

        keep_loaded()
        model = load_model(folder, self.device)
        tracker = Tracker(model)
        about: dict[str, Any] = {
            "notes": self._notes(views, points, tracker.anatomy_ct),
            "input": [],
            "model": model.provenance,
            "model_sha256": store.sha256_of(folder / store.MANIFEST),
            "cloud_sha256": store.sha256_of(self.cloud),
        }
        seen, organs = Seen(content=views[0].content, ct=self._ct(model, tracker.anatomy_ct)), []
        try:
            for view in views:
                organ, done, taken = self._organ(view, model, hints)
                organs.append(organ)
                about["input"].append(done)
                if view is views[0]:
                    seen = replace(seen, cloud=organ, taken=taken)
            looks = looks_at(organs, [view.content for view in views], fixed_from_camera)
            estimate = tracker.locate(organs[0], self.grid, self.seed, views[0].content, looks)
        except NoEstimate as error:
            from tumortrack.report.run_page import write_run_page
            from tumortrack.tracking.files import write_no_estimate

            report = {**self._nothing(str(error), views[0], model), **about}
            add = partial(write_run_page, report=report, estimate=None, seen=seen)
            write_no_estimate(out, report, overwrite, add)
            if self.json:
                say_json(report)
            reason = report["quality"]["reason"]
            raise NoEstimate(f"none: {reason} What was seen: {out / PAGE}") from error
        if estimate.quality == "poor" and views[0].unit is not None:
            doubt = f"if that is not the organ, or not all of it: {_ASK}; --whole takes all."
            about["notes"].append(doubt)
        about |= self._about_files(estimate, clouds, frame_id, fixed_from_camera, points)
        _say_found(estimate, about)
        # What writing alone needs is loaded after the verdict, for which the user waits.
        from tumortrack.report.run_page import write_run_page
        from tumortrack.tracking.files import report_entry, write_estimate

        report = {**report_entry(estimate), **about}
        add = partial(write_run_page, report=report, estimate=estimate, seen=seen)
        write_estimate(out, estimate, overwrite, points, add, about)
        _say_written(estimate, points, out)
        if self.json:
            say_json(report)
        return VERDICTS[estimate.quality]

    def _about_files(
        self,
        estimate: Estimate,
        clouds: list[Path],
        frame_id: str,
        fixed_from_camera: tuple[Affine, ...],
        points: PointTable | None,
    ) -> dict[str, Any]:
        """Of --poses and --map, for the report."""
        about: dict[str, Any] = {}
        if self.poses is not None and estimate.report.looks is not None:
            about["looks"] = {
                **to_builtins(estimate.report.looks),
                "frame_id": frame_id,
                "fixed_from_camera": fixed_from_camera[0].tolist(),
                "poses_sha256": store.sha256_of(self.poses),
                "clouds_sha256": [store.sha256_of(path) for path in clouds],
            }
        if self.map is not None and points is not None:
            digest, count = store.sha256_of(self.map), len(points.points_ct)
            about["map"] = {"points": count, "from": "lps", "to": "camera", "sha256": digest}
        return about

    def _views(self, clouds: list[Path]) -> list[View]:
        from tumortrack.cli.views import read_view

        return [
            read_view(path, self.unit, camera, self.depth_unit)
            for path, camera in zip(clouds, self._cameras(len(clouds)), strict=True)
        ]

    def _notes(
        self, views: list[View], points: PointTable | None, anatomy_ct: Anatomy | None
    ) -> list[str]:
        """What was dropped in reading, and which points of --map lie far from the organ."""
        from tumortrack.tracking.points import check_near_organ

        notes = [note for view in views for note in view.notes]
        if points is not None:
            assert anatomy_ct is not None  # a model with a shape
            box_mm = anatomy_ct.organ.box_mm
            notes += [*points.notes, *check_near_organ(points.points_ct, box_mm, str(self.map))]
        return notes

    def _organ(
        self, view: View, model: Model, hints: Hints
    ) -> tuple[SensorCloud, dict[str, Any], np.ndarray | None]:
        """See ``View.organ``."""
        from tumortrack.core.types import SensorCloud

        if isinstance(view.content, SensorCloud) and self.box is None:
            return *view.alone(self.range), None
        given = {
            "--box": self.box,
            f"--at {' '.join(map(str, self.at or ()))}": self.at,
            f"--mask {self.mask}": self.mask,
            "--whole": self.whole,
        }
        by = " and ".join(name for name, value in given.items() if value)
        by = by or "shape, size and place alone"
        return view.organ(self.region(model), hints, by, self.seed)

    def _nothing(self, reason: str, view: View, model: Model) -> dict[str, Any]:
        """The report's head, where there is no estimate."""
        from tumortrack.tracking.files import report_head

        if view.unit is not None:
            reason = f"{reason.rstrip('.')}; {_ASK}."
        return {
            **report_head(view.content.stamp_ns),
            "seed": self.seed,
            "patient": to_builtins(model.patient),
            "quality": {"verdict": "none", "reason": reason},
        }

    def _ct(self, model: Model, anatomy_ct: Anatomy | None) -> CarriedCt | None:
        """The CT of --case, if it has one."""
        if self.case is None:
            return None
        from tumortrack.imaging.case import load_case
        from tumortrack.live.viewer.slices import CarriedCt

        case = load_case(self.case)
        same = store.sha256_of(self.case / store.MANIFEST) == model.provenance.get("case_sha256")
        if not same or anatomy_ct is None:
            raise InputError(
                f"--case {self.case} shows nothing here: "
                + ("the model knows no motion; give the case itself in its place."
                   if same else "the model is of another case. Give that one.")
            )  # fmt: skip
        return None if case.ct is None else CarriedCt(case)

    def _points(self, folder: Path) -> PointTable | None:
        """The points of --map; what is wrong with them or the model is said before a wait."""
        from tumortrack.models.folder import has_shape, patient_of, read_model_manifest
        from tumortrack.tracking.points import read_points

        manifest = read_model_manifest(folder)
        patient_of(manifest, folder).check_is(self.stated, str(self.model))
        if self.map is None:
            return None
        if not has_shape(manifest):
            raise InputError(
                f"--map: {self.model} says what is where, but not which point of the CT lies "
                "there. The case itself knows: give CASE in place of MODEL."
            )
        return read_points(self.map)

    def _poses(self, views: int) -> tuple[str, tuple[Affine, ...]]:
        """The fixed frame's name, and where the views' cameras were in it."""
        from tumortrack.sense.files import read_poses

        if self.poses is None and views == 1:
            return "", ()
        if self.poses is None or views == 1:
            raise InputError(
                f"{views} view{'s' * (views > 1)} with{'out' * (self.poses is None)} --poses: give "
                "--poses FILE with several views (locate MODEL CLOUD CLOUD ... OUT), and only then."
            )
        return read_poses(self.poses, views)

    def _cameras(self, views: int) -> tuple[Path | None, ...]:
        """The file of each view's intrinsics."""
        given = self.intrinsics or (None,)
        if len(given) not in (1, views):
            raise InputError(
                f"--intrinsics is given {len(given)} times for {views} view{'s' * (views > 1)}: "
                "give it once for all of them, or once for each, in their order."
            )
        return given if len(given) == views else given * views


def looks_at(
    organs: Sequence[SensorCloud],
    seen: Sequence[SensorCloud | DepthFrame],
    fixed_from_camera: Sequence[Affine],
) -> list[Look]:
    """All views but the first, whose frame is the answer's."""
    import numpy as np

    from tumortrack.core.types import Look

    return [
        Look(organ, content, np.linalg.inv(fixed_from_camera[0]) @ pose)
        for organ, content, pose in list(
            zip(organs, seen, fixed_from_camera or [np.eye(4)], strict=True)
        )[1:]
    ]


def _say_found(estimate: Estimate, about: dict[str, Any]) -> None:
    """How far it is to be trusted, and what is where."""
    from tumortrack.core.estimate import verdict_words
    from tumortrack.report.seen import part_rows, row_words
    from tumortrack.tracking.margins import margin_words

    report, margin = estimate.report, estimate.report.margin
    say(verdict_words(estimate.quality, estimate.reason))
    say(str(estimate.patient))
    for row in part_rows(report, estimate.quality == "good"):
        say(row_words(row))
    if margin is None or not margin.stated:
        say(margin_words(margin))
    for view in about["input"]:
        say(view["words"])
    say_notes(about["notes"])


def _say_written(estimate: Estimate, points: PointTable | None, out: Path) -> None:
    from tumortrack.registration.kernels import carry
    from tumortrack.report.seen import PAGE
    from tumortrack.tracking.margins import stated_radius

    if points is not None:
        radius = stated_radius(estimate.report.margin, "map")
        said = f"; {radius.words} for all of them" if radius else ""
        file = out / "points.csv"
        say(f"{len(points.points_ct)} points of the CT: their places are in {file}{said}")
    seconds = estimate.report.timings["total"]
    compiled = ", with compiling, once on this machine" if carry.stats.cache_misses else ""
    say(f"written to {out} (camera frame, mm) in {seconds:.2f} s{compiled}; look at {out / PAGE}.")


def check_grid(grid: int) -> None:
    from tumortrack.core.estimate import LARGEST_GRID

    if not 8 <= grid <= LARGEST_GRID:
        raise InputError(f"--grid {grid} is not allowed; choose 8 to {LARGEST_GRID}.")
