"""`locate`: from the files of one or several views to an estimate and its folder."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tumortrack.assessment.bound import depths_within_mm
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.evidence import CAMERA
from tumortrack.core.wording import for_caller
from tumortrack.io.points import PointTable, check_near_organ, read_points
from tumortrack.report.seen import PAGE, Seen
from tumortrack.tracking.options import LocateOptions, check_grid, model_folder
from tumortrack.tracking.views import (
    NO_CLOUD,
    OrganInView,
    ViewFile,
    as_fitted,
    further_views,
    read_places,
    read_views,
)

if TYPE_CHECKING:
    from tumortrack.core.estimate import Estimate
    from tumortrack.core.types import Anatomy
    from tumortrack.registration.base_model import Model
    from tumortrack.report.slices import CarriedCt

_ASK = "say where the organ is: --at COLUMN ROW, --box or --mask"


@dataclass(frozen=True, eq=False)
class Located:
    """The result of ``locate``, to be saved.

    Attributes:
        estimate: None if nothing could be located; ``reason`` then says why.
        about: the entries of report.json besides the estimate: notes, inputs, model, digests.
        seen: what the page shows besides the estimate.
        points: points of the CT to map to the camera frame.
        error: why there is no estimate.
    """

    estimate: Estimate | None
    about: dict[str, Any] = field(default_factory=dict)
    seen: Seen = field(default_factory=Seen)
    points: PointTable | None = None
    error: NoEstimate | None = None

    @property
    def reason(self) -> str:
        return self.about["quality"]["reason"] if self.estimate is None else self.estimate.reason

    @cached_property
    def report(self) -> dict[str, Any]:
        from tumortrack.io.run_folder import report_entry

        head = {} if self.estimate is None else report_entry(self.estimate)
        return {**head, **self.about}

    def show(self) -> None:
        """Show the page: within a notebook, else in the browser; without a display, print where it
        is. Raises StorageError: the disk refused."""
        from tumortrack.report.page import write_run_page
        from tumortrack.report.showing import show

        folder = Path(tempfile.mkdtemp(prefix="tumortrack-"))
        write_run_page(folder, self.report, self.estimate, self.seen)
        show(folder / PAGE)

    def save(self, folder: str | Path, overwrite: bool = False) -> None:
        """Write the folder that `tumortrack locate` writes. Raises InputError: it exists and
        ``overwrite`` is False; StorageError: the disk refused."""
        from safetensors.numpy import save

        from tumortrack.io import run_folder as files
        from tumortrack.registration.motion import ElasticMotion
        from tumortrack.report.page import write_run_page

        report, folder = self.report, Path(folder)

        def add(new: Path) -> None:
            write_run_page(new, report, self.estimate, self.seen)
            motion = None if self.estimate is None else self.estimate.motion
            if isinstance(motion, ElasticMotion) and motion.covariance is not None:
                store.write_atomically(new / files.MOTION, save(motion.to_arrays()))

        if self.estimate is None:
            files.write_no_estimate(folder, report, overwrite, add)
        else:
            files.write_estimate(folder, self.estimate, overwrite, self.points, add, self.about)


def locate(given: Path, clouds: Sequence[Path], options: LocateOptions) -> Located:
    """Locate in views of an organ at rest, with a model or case; see ``api.locate_files``."""
    check_grid(options.grid)
    folder = model_folder(given)
    points = _points(given, folder, options)
    frame_id, fixed_from_camera = read_places(options.poses, len(clouds))
    views = read_views(clouds, options)
    hints = views[0].hints(options.at, options.mask)

    from tumortrack.report.known_evidence import read_known
    from tumortrack.tracking.model_files import load_model
    from tumortrack.tracking.tracker import Tracker

    model = load_model(folder, options.device)
    known = read_known(options, model.parts, clouds[0] != NO_CLOUD)
    tracker = Tracker(model, options.advise)
    about: dict[str, Any] = {
        "notes": [
            *(weakness.message for weakness in model.warnings),
            *_notes(views, points, tracker.anatomy_ct, options),
            *known.notes,
        ],
        "input": [],
        "model": model.provenance,
        "model_sha256": store.sha256_of(folder / store.MANIFEST),
        "cloud_sha256": None if clouds[0] == NO_CLOUD else store.sha256_of(clouds[0]),
    }
    seen = Seen(content=views[0].content, ct=_ct(options.case, model, tracker.anatomy_ct))
    found: list[OrganInView] = []
    try:
        found.extend(view.organ(model, options, hints) for view in views)
        organs = [organ.cloud for organ in found]
        others = further_views(organs, views, fixed_from_camera)
        estimate = tracker.locate(
            organs[0],
            views=others,
            evidence=known.pieces,
            full_view=views[0].content,
            grid=options.grid,
            seed=options.seed,
            frame=known.frame,
        )
    except NoEstimate as error:
        about["input"] = [organ.entry for organ in found]
        about = {**_no_estimate(error, views[0], model, options), **about}
        seen = (
            replace(seen, cloud=found[0].cloud, pixel_class=found[0].pixel_class) if found else seen
        )
        return Located(None, about, seen, points, error)
    found = as_fitted(views, found, estimate, model)
    about["input"] = [organ.entry for organ in found]
    seen = replace(seen, cloud=found[0].cloud, pixel_class=found[0].pixel_class)
    if estimate.quality == "poor" and views[0].unit is not None:
        doubt = f"if that is not the organ, or not all of it: {_ASK}; --whole takes all."
        about["notes"].append(doubt)
    unstated = any(organ.depth_error is None for organ in organs)
    if unstated and estimate.report.motion is not None and clouds[0] != NO_CLOUD:
        within_mm = depths_within_mm(estimate.report, model.parts[0])
        about["notes"].append(
            f"depths may be {within_mm:.1f} mm off here (95 %), all alike: "
            "nobody says how well this camera is calibrated (--depth-error; of depth images also "
            "depth_left_mm in the intrinsics file)."
        )
    if fixed_from_camera and options.poses and estimate.report.views is not None:
        about["views"] = {
            **to_builtins(estimate.report.views),
            "frame_id": frame_id,
            "fixed_from_camera": fixed_from_camera[0].tolist(),
            "poses_sha256": store.sha256_of(options.poses),
            "clouds_sha256": [store.sha256_of(path) for path in clouds],
        }
    about["notes"] += [probe.message for probe in estimate.report.probes]
    if known.frame != CAMERA:
        about["notes"].append(
            f"all places are in the frame {known.frame!r}: the organ may lie any way."
        )
    about |= known.sha256
    if options.map is not None and points is not None:
        digest, count = store.sha256_of(options.map), len(points.points_ct)
        about["map"] = {"points": count, "from": "lps", "to": "camera", "sha256": digest}
    about["notes"] = list(map(for_caller, about["notes"]))
    return Located(estimate, about, seen, points)


def _points(given: Path, folder: Path, options: LocateOptions) -> PointTable | None:
    """The points of --map, checked like the model's patient before the model is loaded."""
    from tumortrack.io.model_folder import has_shape, patient_of, read_model_manifest

    manifest = read_model_manifest(folder)
    patient_of(manifest, folder).check_is(options.stated, str(given))
    if options.map is None:
        return None
    if not has_shape(manifest):
        raise InputError(
            f"--map: {given} says what is where, but not which point of the CT lies "
            "there. The case itself knows: give CASE in place of MODEL."
        )
    return read_points(options.map)


def _notes(
    views: list[ViewFile],
    points: PointTable | None,
    anatomy_ct: Anatomy | None,
    options: LocateOptions,
) -> list[str]:
    """On what was dropped in reading, and on points of --map far from the organ."""
    notes = [note for view in views for note in view.notes]
    if points is not None:
        assert anatomy_ct is not None  # a model with a shape
        box_mm = anatomy_ct.organ.box_mm
        notes += [*points.notes, *check_near_organ(points.points_ct, box_mm, str(options.map))]
    return notes


def _no_estimate(
    error: NoEstimate, view: ViewFile, model: Model, options: LocateOptions
) -> dict[str, Any]:
    """The first entries of a report without an estimate."""
    from tumortrack.io.run_folder import finding_entry, report_head

    reason = str(error)
    if view.unit is not None:
        reason = f"{reason.rstrip('.')}; {for_caller(_ASK)}."
    return {
        **report_head(view.content.stamp_ns),
        "seed": options.seed,
        "patient": to_builtins(model.patient),
        "quality": {"verdict": "none", "reason": reason},
        "assessment": {"finding": finding_entry(error.finding)},
    }


def _ct(folder: Path | None, model: Model, anatomy_ct: Anatomy | None) -> CarriedCt | None:
    """The CT of --case, if it has one."""
    if folder is None:
        return None
    from tumortrack.io.case import load_case
    from tumortrack.report.slices import CarriedCt

    case = load_case(folder)
    same = store.sha256_of(folder / store.MANIFEST) == model.provenance.get("case_sha256")
    if not same or anatomy_ct is None:
        raise InputError(
            f"--case {folder} shows nothing here: "
            + ("the model knows no motion; give the case itself in its place."
               if same else "the model is of another case. Give that one.")
        )  # fmt: skip
    return None if case.ct is None else CarriedCt(case)
