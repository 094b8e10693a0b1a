"""Cases and scenes: `prepare`, `export`, `simulate`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from tumortrack.cli.console import progress_bar, progress_of, say, say_notes
from tumortrack.core import store
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.report.slicer_scene import Scene
    from tumortrack.simulate.scene import SceneConfig


@dataclass(frozen=True, kw_only=True)
class Prepare:
    """Make a case from a CT, a label map or a folder of meshes.

    Attributes:
        input: DICOM folder, CT volume or label map (.nii, .nii.gz, .nrrd), or folder of meshes.
        case: folder to write.
        name: which organ it is; its files, parts and topics bear this name.
        term: SNOMED CT code and meaning of the organ, where NAME is none of the usual ones.
        structure: NAME=NUMBER (a label) or NAME=PATH (a mesh, closed or open), again for every
            one: vessels and the like, which move with the organ.
        organ_hu: HU window of the organ in a CT: low (inclusive) and high.
        tumor_hu: HU window of the tumors in a CT.
        labels: the input is a label map (mostly recognised by itself).
        segment: segment the CT by a tool of yours, with weights that you have:
            totalsegmentator, totalsegmentator:TASK (liver_lesions, ...: also tumors),
            nnunet:FOLDER or monai:BUNDLE. Its label map is kept beside CASE (docs/segment.md).
        side: of organs in pairs, the patient's one to take from a label map (default: the one
            with most tumor); of a CT or meshes, which one it is.
        organ: label number of the organ.
        tumor: label number of the tumors; default: every label from 2 up. 0: none.
        up: patient direction that faces the camera: anterior, left, ... or "x,y,z" in LPS.
        rotations: how the organ may lie then: turned about the line of sight and tilted by up to
            TILT, or in any way (full). What is excluded here is never the answer.
        tilt: degrees, about each axis across the line of sight.
        sensor: the camera that will see it: a RealSense D405, or a stereo endoscope, whose depth
            is matched.
        series: which DICOM series, if the folder holds several (UID or number in the list).
        unit: of mesh files.
        min_tumor_ml: smaller tumors are reported and dropped.
        patient: whose organ it is (default: DICOM's PatientID). It is stored in every folder and
            message that follows; a pseudonym keeps the PatientID out of them.
        overwrite: replace CASE if it exists.
    """

    input: Positional[Path]
    case: Positional[Path]
    name: str = "kidney"
    term: tuple[str, str] | None = None
    structure: UseAppendAction[tuple[str, ...]] = ()
    organ_hu: Annotated[tuple[float, float], arg(aliases=["--kidney-hu"])] = (-300.0, 300.0)
    tumor_hu: tuple[float, float] = (300.0, 1000.0)
    labels: bool = False
    segment: str | None = None
    side: Literal["left", "right"] | None = None
    organ: int = 1
    tumor: int | None = None
    up: str = "anterior"
    rotations: Literal["limited", "full"] = "limited"
    tilt: float = 30.0
    sensor: Literal["d405", "stereo"] = "d405"
    series: str | None = None
    unit: Literal["mm", "m"] | None = None
    min_tumor_ml: float = 0.2
    patient: str | None = None
    overwrite: bool = False

    def run(self) -> None:
        with progress_of("the case's model", f"reading {self.input}, making surfaces ...") as made:
            from tumortrack import api
            from tumortrack.imaging.prepare import PrepareOptions

            options = {field.name: getattr(self, field.name) for field in fields(PrepareOptions)}
            case = api.prepare(
                self.input, self.case, overwrite=self.overwrite, segment=self.segment,
                progress=made, **options,
            )  # fmt: skip
        say_notes(case.report.get("notes", []))
        say(str(case.patient))
        kind = case.anatomy.kind
        if not kind.identified(case.patient):
            both = "both (--patient ID --side left|right): real arms need them"
            say_notes([f"state {both if kind.in_pairs else '--patient ID: real arms need it'}"])
        for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
            say(f"{name}: {part.volume_ml:.1f} ml")
        say(f"case written to {self.case}; look at {self.case / 'qc.png'} before you rely on it.")


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a case, or what was located, as a scene for 3D Slicer, and a CT's as DICOM.

    Attributes:
        case: folder that `prepare` wrote, or alone one that `locate` wrote.
        out: folder to write: scene.mrb; of a case also case.seg.nrrd, structures as
            PLY and, with --dicom, segmentation.dcm.
        located: folder that `locate` wrote with this case's model: the scene shows its surfaces,
            and the CT and its segmentation where the organ is.
        live: HOST:PORT of a sink `openigtlink`: the scene connects to it, shows what it sends, and
            has the CT follow the organ.
        dicom: folder of the CT's slices that the case's voxels come from.
        series: which of its series, if the folder holds several (UID or number in the list).
        patient: the PatientID of --dicom, where the case has a pseudonym.
    """

    case: Positional[Path]
    out: Positional[Path]
    located: Path | None = None
    live: str | None = None
    dicom: Path | None = None
    series: str | None = None
    patient: str | None = None

    def run(self) -> None:
        from tumortrack.report.slicer_scene import Scene
        from tumortrack.tracking.files import read_report

        if self.dicom is None and (self.series, self.patient) != (None, None):
            raise InputError("--series and --patient are those of --dicom; give that folder too.")
        if self.located is not None and self.live is not None:
            raise InputError("--located shows what is done, --live what comes: give one of them.")
        manifest = self.case / store.MANIFEST
        is_run = manifest.is_file() and store.read_json(manifest).get("kind") == "run"
        if is_run and (self.located, self.live, self.dicom) != (None, None, None):
            raise InputError(
                f"{self.case} was located. --located, --live and --dicom are for a case: "
                "tumortrack export CASE OUT --located RUN."
            )
        scene = Scene()
        notes: tuple[str, ...] = ()
        with store.new_folder(self.out) as aside:
            if is_run:
                scene.add_run(self.case, read_report(self.case))
            else:
                notes = self._export_case(aside, scene)
            scene.write(aside / "scene.mrb")
        say_notes(notes)
        say(f"written to {self.out}: {', '.join(sorted(p.name for p in self.out.iterdir()))}.")

    def _export_case(self, aside: Path, scene: Scene) -> tuple[str, ...]:
        """Adds the case to the scene and writes what else was asked for; notes."""
        from tumortrack import api
        from tumortrack.core.mesh_files import write_mesh
        from tumortrack.core.patient import Patient
        from tumortrack.imaging import segmentation_files as segmentation

        case = api.load_case(self.case)
        labels, patient = case.labels, case.patient
        parts = segmentation.segments(case.anatomy.names, patient.side, case.anatomy.kind)
        file = aside / "case.seg.nrrd"
        segmentation.write_seg_nrrd(file, labels.labels, labels.lps_from_index, parts)
        for name, mesh in case.anatomy.structures.items():
            write_mesh(aside / f"{name}.ply", mesh)
        moved = (self.located, self.live) != (None, None)
        scene.add_case(self.case, case, file.read_bytes(), moved)
        if self.located is not None:
            report = self._report_of(self.located)
            scene.add_ct_transform(report["motion"]["camera_from_ct"])
            scene.add_run(self.located, report)
        if self.live is not None:
            host, _, port = self.live.rpartition(":")
            if not host or not port.isdecimal():
                raise InputError(f"--live {self.live!r} must be HOST:PORT, as localhost:18944.")
            scene.add_ct_transform(None)
            scene.add_live(case.anatomy.names, host, int(port))
        if self.dicom is None:
            return ()
        series = self.series or case.report.get("options", {}).get("series")
        whose = Patient(patient.id if self.patient is None else self.patient, patient.side)
        file = aside / "segmentation.dcm"
        return segmentation.write_dicom_seg(file, labels, parts, self.dicom, series, whose)

    def _report_of(self, run: Path) -> dict[str, Any]:
        """Raises InputError: it was located with another case's model, or without a motion."""
        from tumortrack.tracking.files import read_report

        report = read_report(run)
        if report.get("model", {}).get("case_sha256") != store.sha256_of(
            self.case / store.MANIFEST
        ):
            raise InputError(f"{run} was not located with a model of {self.case}: give its case.")
        if "motion" not in report:
            raise InputError(
                f"{run} does not know where the CT is now: a model of the preset clinic does. "
                "Export it alone: tumortrack export RUN OUT."
            )
        return report


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Write deformed scenes of a case with their truth: what `evaluate` reads.

    Attributes:
        case: folder that `prepare` wrote.
        dataset: folder to write.
        scenes: how many.
        seed: of the scenes; they are never those that training sees.
        configuration: of the paper's deformation table; several are mixed.
        falloff: how the table's third number is read (docs/method.md).
        rotations: poses, as in `train`.
        squeeze: also squeeze and bend the organ as a whole.
        noise: with the depth sensor's noise.
        sensor: whose, as in `train`.
        elastic: deform the organ as an elastic body in its bed does (plates, instruments, pulls,
            weight, swelling), instead of by the paper's table.
    """

    case: Positional[Path]
    dataset: Positional[Path]
    scenes: int = 20
    seed: int = 0
    configuration: tuple[Literal[1, 2, 3, 4, 5, 6], ...] = (3,)
    falloff: Literal["sigma", "variance"] = "sigma"
    rotations: Literal["limited", "full"] = "limited"
    squeeze: bool = False
    noise: bool = True
    sensor: Literal["d405", "stereo"] = "d405"
    elastic: bool = False

    def run(self) -> None:
        self.write()
        say(f"{self.scenes} scenes written to {self.dataset}.")

    def scene_config(self) -> SceneConfig:
        from tumortrack.sense.noise import CLEAN, SENSORS
        from tumortrack.simulate import deform
        from tumortrack.simulate.deform.drag import CONFIGURATIONS
        from tumortrack.simulate.scene import PoseConfig, SceneConfig

        models: list[deform.DragConfig | deform.ElasticConfig] = [deform.ElasticConfig()]
        if not self.elastic:
            table = (CONFIGURATIONS[number] for number in self.configuration)
            models = [deform.DragConfig(steps=steps, falloff=self.falloff) for steps in table]
        chains = [deform.ChainConfig(links=(model, deform.StretchConfig())) for model in models]
        return SceneConfig(
            width=848,
            height=480,
            pose=PoseConfig(rotations=self.rotations),
            deform=tuple(chains if self.squeeze else models),
            noise=SENSORS[self.sensor] if self.noise else CLEAN,
        )

    def write(self, prefix: str = "") -> None:
        """Scenes PREFIX0000, PREFIX0001, ... of the ``test`` stream; those that are there stay."""
        from tumortrack import api
        from tumortrack.core.config import to_builtins
        from tumortrack.simulate.scene import SceneRecipe

        if self.scenes < 1:
            raise InputError(f"--scenes {self.scenes} must be at least 1.")
        case = api.load_case(self.case)
        config = self.scene_config().seen_whole(case.anatomy)
        about = {
            "case_sha256": store.sha256_of(self.case / store.MANIFEST),
            "case_volumes_mm3": [part.volume_mm3 for part in case.anatomy.parts],
            "config": to_builtins(config),
        }
        with progress_bar("simulate", self.scenes) as advance:
            make = api.scene_maker(case, config, self.seed)
            for index in range(self.scenes):
                folder = self.dataset / f"{prefix}{index:04d}"
                if folder.exists():
                    made_from = {**about, "recipe": asdict(SceneRecipe(self.seed, "test", index))}
                    meta = store.read_json(folder / "meta.json")
                    if {key: meta.get(key) for key in made_from} != made_from:
                        raise InputError(
                            f"{folder} is a scene of another case, seed or option. Choose another "
                            "DATASET folder."
                        )
                else:
                    scene = make(index)
                    replace(scene, meta={**about, **scene.meta}).write(folder)
                advance()
