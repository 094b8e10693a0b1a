"""Cases and scenes, and what is in any folder: `prepare`, `export`, `simulate`, `evaluate`,
`inspect`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

from tumortrack.case.options import ORGAN_HU, PrepareOptions
from tumortrack.cli.console import (
    Device,
    inputs_and_out,
    keep_loaded,
    model_folder,
    options_of,
    progress_bar,
    progress_of,
    say,
    say_notes,
    say_table,
)
from tumortrack.tracking.options import ExportOptions, SimulateOptions, check_grid

_USAGE = "prepare INPUT [MORE ...] --out CASE"


@dataclass(frozen=True, kw_only=True)
class Prepare(PrepareOptions):
    """Make a case from a CT, a label map or a folder of meshes.

    Attributes:
        input: DICOM folder, CT volume, label map or segmentation (.nii, .nii.gz, .nrrd, .seg.nrrd,
            DICOM), folder of meshes or of label files with one structure each.
        more: further files of meshes or labels.
        out: folder to write: the case.
        segment: segment the CT by a tool of yours, with weights that you have:
            totalsegmentator, totalsegmentator:TASK (liver_lesions, ...: also tumors),
            nnunet:FOLDER or monai:BUNDLE. Its label map is kept beside CASE (docs/segment.md).
        overwrite: replace CASE if it exists.
    """

    input: Positional[Path]
    more: Positional[tuple[Path, ...]] = ()
    out: Path | None = None
    organ_hu: Annotated[tuple[float, float], arg(aliases=["--kidney-hu"])] = ORGAN_HU
    side: Literal["left", "right"] | None = None
    unit: Literal["mm", "m"] | None = None
    organ: UseAppendAction[tuple[int, ...]] = ()
    tumor: UseAppendAction[tuple[int, ...]] = ()
    structure: UseAppendAction[tuple[str, ...]] = ()
    segment: str | None = None
    overwrite: bool = False

    def run(self) -> None:
        inputs, folder = inputs_and_out((self.input, *self.more), self.out, _USAGE)
        words = ", ".join(map(str, inputs))
        with progress_of("the case's model", f"reading {words}, making surfaces ...") as made:
            from tumortrack import api
            from tumortrack.io.model_folder import (
                is_finished,
                read_model_manifest,
                reliability_warning,
            )

            case = api.prepare(
                inputs, folder, overwrite=self.overwrite, segment=self.segment,
                progress=made, **options_of(self, PrepareOptions),
            )  # fmt: skip
        model, weakness = folder / case.MODEL, ""
        if is_finished(model):
            weakness = reliability_warning(read_model_manifest(model)["provenance"])
        notes = *(each.message for each in case.warnings), weakness, *case.report.get("notes", [])
        say_notes(filter(None, notes))
        say(str(case.patient))
        kind = case.anatomy.organ_kind
        if not kind.identified(case.patient):
            both = "both (--patient ID --side left|right): real arms need them"
            say_notes([f"state {both if kind.in_pairs else '--patient ID: real arms need it'}"])
        for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
            say(f"{name}: {part.volume_ml:.1f} ml")
        say(f"case written to {folder}; look at {folder / 'qc.png'} before you rely on it.")


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions):
    """Write a case, or what was located, as a scene for 3D Slicer, and a CT's as DICOM, or as a
    body for a simulator.

    Attributes:
        case: folder that `prepare` wrote, or alone one that `locate` wrote.
        out: folder to write: scene.mrb; of a case also case.seg.nrrd, structures as
            PLY and, with --dicom, segmentation.dcm. Of a body: body.tets.vtk, rest.tets.vtk and a
            .vtk of each surface, or body.usda; and body.json.
    """

    case: Positional[Path]
    out: Positional[Path]

    def run(self) -> None:
        from tumortrack import api

        say_notes(api.export(self.case, self.out, **options_of(self, ExportOptions)))
        say(f"written to {self.out}: {', '.join(sorted(p.name for p in self.out.iterdir()))}.")


@dataclass(frozen=True, kw_only=True)
class Simulate(SimulateOptions):
    """Write deformed scenes of a case with their truth: what `evaluate` reads.

    Attributes:
        case: folder that `prepare` wrote.
        dataset: folder to write.
    """

    case: Positional[Path]
    dataset: Positional[Path]

    def run(self) -> None:
        from tumortrack import api

        options = options_of(self, SimulateOptions)
        with progress_bar("simulate", self.scenes) as advance:
            api.write_scenes(self.case, self.dataset, progress=advance, **options)
        say(f"{self.scenes} scenes written to {self.dataset}.")


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Locate in every scene of a folder and compare with the truth.

    Attributes:
        model: a case, or a folder that `train` wrote.
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
        from tumortrack.report.protocol import check_place

        check_grid(self.grid)
        check_place(self.report, self.overwrite)
        result = self.write()

        from tumortrack.report.summary import conclusions, error_table, headlines, part_table

        for table in (error_table(result["summary"]), part_table(result["summary"])):
            say_table(table)
        for line in (*conclusions(result["scenes"]), *headlines(result["summary"])):
            say(line)
        if missing := result["baselines"].get("not_available"):
            say(missing)
        say(f"written to {self.report / 'report.json'}; look at {self.report / 'index.html'}.")

    def write(self) -> dict[str, Any]:
        """Write the report, replacing an earlier one; returns it."""
        from tumortrack.io.model_folder import patient_of, read_model_manifest
        from tumortrack.io.scene_folder import list_scenes

        folder = model_folder(self.model)
        patient = patient_of(read_model_manifest(folder), folder)
        count = len(list_scenes(self.variants))
        say(f"comparing {self.model} with the truth of {count} scenes; loading it ...")
        say(str(patient))

        from tumortrack.report.protocol import evaluate_model

        keep_loaded()
        with progress_bar("evaluate", count) as advance:
            return evaluate_model(
                folder, self.variants, self.report, self.grid, self.seed, self.device, advance
            )


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Say what a folder or file is, and what is in it.

    Attributes:
        path: what a command wrote or reads.
    """

    path: Positional[Path]

    def run(self) -> None:
        from tumortrack.report.inspection import describe

        for line in describe(self.path):
            say(line)
