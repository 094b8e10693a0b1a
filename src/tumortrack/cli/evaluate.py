"""A model on scenes whose truth is known: `evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from tumortrack.cli.console import Device, console, keep_loaded, model_folder, progress_bar, say
from tumortrack.tracking.options import check_grid


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
        """Write the report, replacing an earlier one; returns it."""
        from tumortrack.models.folder import patient_of, read_model_manifest
        from tumortrack.simulate.scene_folder import list_scenes

        folder = model_folder(self.model)
        patient = patient_of(read_model_manifest(folder), folder)
        count = len(list_scenes(self.variants))
        say(f"comparing {self.model} with the truth of {count} scenes; loading it ...")
        say(str(patient))

        from tumortrack.report.protocol import evaluate_model
        from tumortrack.report.summary import headlines, scene_lines, summary_tables

        keep_loaded()
        out = self.report
        with progress_bar("evaluate", count) as advance:
            result = evaluate_model(
                folder, self.variants, out, self.grid, self.seed, self.device, advance
            )
        for table in summary_tables(result):
            console.print(table)
        for line in (*scene_lines(result["scenes"]), *headlines(result["summary"])):
            say(line)
        if missing := result["rivals"].get("not_available"):
            say(missing)
        say(f"written to {out / 'report.json'}; look at {out / 'index.html'}.")
        return result
