"""A model on scenes whose truth is known: `evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from tumortrack.cli.console import Device, console, keep_loaded, model_folder, progress_bar, say
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.tracking.options import check_grid

if TYPE_CHECKING:
    from tumortrack.models.model import Model


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
        from tumortrack.report.place import check_place

        check_grid(self.grid)
        check_place(self.report, self.overwrite)
        self.write()

    def write(self) -> dict[str, Any]:
        """The report, whatever lies in its place."""
        from tumortrack.models.folder import read_model_manifest
        from tumortrack.simulate.scene_folder import list_scenes

        folder = model_folder(self.model)
        read_model_manifest(folder)
        folders = list_scenes(self.variants)
        say(f"comparing {self.model} with the truth of {len(folders)} scenes; loading it ...")

        from tumortrack.report.protocol import evaluate_scenes
        from tumortrack.report.rivals import rivals_of
        from tumortrack.report.summary import headlines, scene_lines, summary_tables
        from tumortrack.tracking.model_files import load_model
        from tumortrack.tracking.tracker import Tracker

        keep_loaded()
        model = load_model(folder, self.device)
        check_case(model, folders)
        say(str(model.patient))
        about = {
            "patient": to_builtins(model.patient),
            "model": model.provenance,
            "model_sha256": store.sha256_of(folder / store.MANIFEST),
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
                f"{folder} shows another case than the one that this model is of, so the "
                "figures would mean nothing. Make scenes of the model's own case with: "
                "tumortrack simulate CASE DATASET."
            )
