"""A model on clouds: `locate` and `evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import Device, console, keep_loaded, progress_bar, say, say_notes
from tumortrack.cli.stated import StatedPatient
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.core.estimate import Estimate
    from tumortrack.core.geometry import Affine
    from tumortrack.core.types import DepthFrame, SensorCloud
    from tumortrack.models.model import Model
    from tumortrack.sense.cloud import CloudConfig
    from tumortrack.tracking.points import PointTable


@dataclass(frozen=True, kw_only=True)
class Locate(StatedPatient):
    """Locate organ and tumors in one cloud or depth image, or in several of the organ at rest.

    Attributes:
        model: folder that `train` wrote.
        cloud: .ply, .pcd or .npz in the camera frame, or a depth .png (with --intrinsics). Several
            views of an organ that does not move in between (CLOUD CLOUD ... OUT) need --poses; the
            answer is in the first one's frame.
        out: folder to write.
        more: with several views: the paths that follow; the last one is OUT.
        poses: JSON with fixed_from_camera (4 x 4 rows for each view, in their order), unit (mm or
            m) and frame_id: where the camera was, in a robot's base, say.
        grid: voxels along the longest side of the labelled volume, up to 400.
        seed: of the random points and queries.
        range: keep depths between NEAR and FAR mm. By default a cloud is used as it is, and a depth
            image is cropped to the range that the model was trained for.
        unit: of the cloud's numbers.
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels: once for all views, or again
            and again, once for each in their order.
        map: points of the CT whose present places to write (OUT/points.csv): a .csv with columns
            x,y,z (LPS, mm), or 3D Slicer's .mrk.json or .fcsv. Needs a model of preset clinic.
        device: auto takes CUDA if there is a GPU.
        overwrite: replace OUT if it exists.
    """

    model: Positional[Path]
    cloud: Positional[Path]
    out: Positional[Path]
    more: Positional[tuple[Path, ...]] = ()
    poses: Path | None = None
    grid: int = 160
    seed: int = 0
    range: tuple[float, float] | None = None
    unit: Literal["mm", "m"] = "mm"
    intrinsics: UseAppendAction[tuple[Path, ...]] = ()
    map: Path | None = None
    device: Device = "auto"
    overwrite: bool = False

    def run(self) -> None:
        _check_grid(self.grid)
        paths = [self.cloud, self.out, *self.more]
        clouds, out = paths[:-1], paths[-1]
        if self.model.is_file() and (self.cloud / store.MANIFEST).is_file():
            raise InputError(
                f"{self.model} stands where the model belongs, and {self.cloud} where the cloud. "
                f"The order is: tumortrack locate {self.cloud} {self.model} {self.out}"
            )
        store.check_place(out, "run", self.overwrite)
        points = self._points()
        frame_id, fixed_from_camera = self._poses(len(clouds))
        views = list(map(self._read, clouds, self._cameras(len(clouds))))
        # What is wrong so far was reported before PyTorch's seconds.
        notes = tuple(note for _, mine in views for note in mine)

        import numpy as np

        from tumortrack.core.types import Look
        from tumortrack.registration.kernels import carry
        from tumortrack.tracking.files import write_estimate
        from tumortrack.tracking.points import check_near_organ
        from tumortrack.tracking.tracker import Tracker
        from tumortrack.training.model import load_model

        keep_loaded()
        model = load_model(self.model, self.device)
        say(str(model.patient))
        tracker = Tracker(model)
        if points is not None:
            assert tracker.anatomy_ct is not None  # a model with a shape
            box_mm = tracker.anatomy_ct.organ.box_mm
            far = check_near_organ(points.points_ct, box_mm, str(self.map))
            notes = (*notes, *points.notes, *far)
        crop = model.config.scene.cloud
        first, *others = [(self._cropped(seen, crop), seen) for seen, _ in views]
        looks = [
            Look(*one, np.linalg.inv(fixed_from_camera[0]) @ pose)
            for one, pose in zip(others, fixed_from_camera[1:], strict=True)
        ]
        estimate = tracker.locate(first[0], self.grid, self.seed, first[1], looks)
        if self.poses is not None:
            estimate.report["looks"] |= {
                "frame_id": frame_id,
                "fixed_from_camera": fixed_from_camera[0].tolist(),
                "poses_sha256": store.sha256_of(self.poses),
                "clouds_sha256": [store.sha256_of(path) for path in clouds],
            }
        if points is not None and self.map is not None:
            estimate.report["map"] = {
                "points": len(points.points_ct),
                "from": "lps",
                "to": "camera",
                "sha256": store.sha256_of(self.map),
            }
        estimate.report.update(
            notes=list(notes),
            model=model.provenance,
            model_sha256=store.sha256_of(self.model / store.MANIFEST),
            cloud_sha256=store.sha256_of(self.cloud),
        )
        write_estimate(out, estimate, self.overwrite, points)
        say_notes(notes)
        _say_found(estimate, points, out)
        seconds = estimate.report["timings"]["total"]
        compiled = ", with compiling, once on this machine" if carry.stats.cache_misses else ""
        say(f"written to {out} (camera frame, mm) in {seconds:.2f} s{compiled}.")

    def _points(self) -> PointTable | None:
        """The points of --map; what is wrong with them or the model is said before a wait."""
        from tumortrack.models.folder import has_shape, patient_of, read_model_manifest
        from tumortrack.tracking.points import read_points

        manifest = read_model_manifest(self.model)
        patient_of(manifest, self.model).check_is(self.stated, str(self.model))
        if self.map is None:
            return None
        if not has_shape(manifest):
            raise InputError(
                f"--map: {self.model} says what is where, but not which point of the CT lies "
                "there. A model of the preset clinic knows: tumortrack train CASE MODEL --preset "
                "clinic."
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

    def _read(
        self, path: Path, intrinsics: Path | None
    ) -> tuple[SensorCloud | DepthFrame, tuple[str, ...]]:
        """What a file holds, and notes."""
        from tumortrack.sense.cloud import check_cloud
        from tumortrack.sense.files import read_cloud, read_depth_png

        if path.suffix.lower() == ".png":
            if intrinsics is None:
                raise InputError(f"{path} is a depth image: give --intrinsics FILE.json with it.")
            if self.unit != "mm":
                raise InputError(
                    "--unit is for clouds; a depth image's unit stands in its intrinsics file as "
                    "depth_unit_mm (mm per step)."
                )
            return read_depth_png(path, intrinsics), ()
        if intrinsics is not None:
            raise InputError(f"--intrinsics is for depth images (.png); {path} is a cloud.")
        cloud, notes = read_cloud(path, self.unit)
        check_cloud(cloud)  # before the crop, which would only say that nothing lies in range
        return cloud, notes

    def _cropped(self, seen: SensorCloud | DepthFrame, trained: CloudConfig) -> SensorCloud:
        import numpy as np

        from tumortrack.core.types import SensorCloud
        from tumortrack.sense.cloud import CloudConfig, cloud_from_depth, crop_cloud

        near, far = self.range or (trained.near_mm, trained.far_mm)
        if isinstance(seen, SensorCloud):
            return crop_cloud(seen, near, far) if self.range else seen
        crop = CloudConfig(near_mm=near, far_mm=far, n_points=trained.n_points)
        return cloud_from_depth(seen, crop, np.random.default_rng(self.seed))


def _say_found(estimate: Estimate, points: PointTable | None, out: Path) -> None:
    """What is where, and how far that is to be trusted."""
    from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED
    from tumortrack.models.margins import margin_words, stated_radius

    margin = estimate.report.get("margin", {})
    for name, part in estimate.report["parts"].items():
        said = "not found"
        if part["found"]:
            x, y, z = part["center_mm"]
            said = f"{part['volume_ml']:.1f} ml, centre ({x:.1f}, {y:.1f}, {z:.1f}) mm"
            said += f", {radius.words}" if (radius := stated_radius(margin, name)) else ""
        say(f"{name}: {said}")
    if points is not None:
        radius = stated_radius(margin, "map")
        said = f"; {radius.words} for all of them" if radius else ""
        file = out / "points.csv"
        say(f"{len(points.points_ct)} points of the CT: their places are in {file}{said}")
    if not margin.get("stated"):
        say(margin_words(margin))
    if estimate.quality == "good":
        say(f"{NO_CHECK_FAILED}; {UNVERIFIED}.")
    else:
        say(f"POOR: {estimate.reason}. Do not rely on it.")


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Locate in every scene of a folder and compare with the truth.

    Attributes:
        model: folder that `train` wrote.
        variants: folder of scene folders.
        report: folder to write: report.json, index.html, pictures.
        grid: voxels along the longest side of the labelled volume.
        seed: of the random points and queries.
        device: auto takes CUDA if there is a GPU.
        overwrite: replace REPORT if it exists.
    """

    model: Positional[Path]
    variants: Positional[Path]
    report: Positional[Path]
    grid: int = 160
    seed: int = 0
    device: Device = "auto"
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack.report.place import check_place

        _check_grid(self.grid)
        check_place(self.report, self.overwrite)
        self.write()

    def write(self) -> dict[str, Any]:
        """The report, whatever lies in its place."""
        from tumortrack.models.folder import read_model_manifest
        from tumortrack.simulate.scene_folder import list_scenes

        read_model_manifest(self.model)
        folders = list_scenes(self.variants)  # report what is wrong before PyTorch's seconds
        say(f"comparing {self.model} with the truth of {len(folders)} scenes; loading it ...")

        from tumortrack.report.protocol import evaluate_scenes
        from tumortrack.report.rivals import rivals_of
        from tumortrack.report.summary import headlines, scene_lines, summary_tables
        from tumortrack.tracking.tracker import Tracker
        from tumortrack.training.model import load_model

        keep_loaded()
        model = load_model(self.model, self.device)
        check_case(model, folders)
        say(str(model.patient))
        about = {
            "patient": to_builtins(model.patient),
            "model": model.provenance,
            "model_sha256": store.sha256_of(self.model / store.MANIFEST),
            "scenes_folder": str(self.variants),
            "grid": self.grid,
            "seed": self.seed,
        }
        locate = partial(Tracker(model).locate, grid=self.grid, seed=self.seed)
        rivals = rivals_of(model)
        with progress_bar("evaluate", len(folders)) as advance:
            out = self.report
            result = evaluate_scenes(locate, self.variants, out, advance, about, rivals)
        for table in summary_tables(result):
            console.print(table)
        for line in (*scene_lines(result["scenes"]), *headlines(result["summary"])):
            say(line)
        if rivals is None:
            say(result["rivals"]["not_available"])
        say(f"written to {out / 'report.json'}; look at {out / 'index.html'}.")
        return result


def check_case(model: Model, folders: list[Path]) -> None:
    """Raises InputError for a scene that `simulate` made of another case than the model's. Scenes
    of other programs do not say which case they show; they pass."""
    wanted = model.provenance.get("case_sha256")
    for folder in folders:
        path = folder / "meta.json"
        stated = store.read_json(path).get("case_sha256") if path.is_file() else None
        if wanted is not None and stated is not None and stated != wanted:
            raise InputError(
                f"{folder} shows another case than the one this model was trained for, so the "
                "figures would mean nothing. Make scenes of the model's own case with: "
                "tumortrack simulate CASE DATASET."
            )


def _check_grid(grid: int) -> None:
    from tumortrack.core.estimate import LARGEST_GRID

    if not 8 <= grid <= LARGEST_GRID:
        raise InputError(f"--grid {grid} is not allowed; choose 8 to {LARGEST_GRID}.")
