"""How far off tumors are by state and organ, on random kidneys, beside rigid poses.

    make accuracy ARGS='OUT --kidneys 12'

Makes random kidneys, their models and stress scenes in OUT, and judges every answer as a fleet
does. The same command goes on where it was stopped. No patient's anatomy is in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from population import grouped, shown

from tumortrack.io.case import load_case
from tumortrack_benchmarks import judging, scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.fleet.checks import described
from tumortrack_benchmarks.fleet.results import tumor_lines
from tumortrack_benchmarks.physics.scenes import random_scenes, simplified
from tumortrack_benchmarks.scripting import KidneyOptions


@dataclass(frozen=True)
class Options(KidneyOptions):
    """Judge answers in stress scenes of random kidneys."""

    kidneys: int = 12
    states: int = 32
    """Of each; families take turns."""


def main(options: Options) -> None:
    """Make what is missing, then the table."""
    writer = scripting.begun("accuracy", options.document)
    work = [(options.out, number, options.states) for number in options.numbers]
    scenes = pd.DataFrame(scripting.together(_rows, work))
    rows = grouped(scenes, organ=scenes.patient)
    table = shown(rows[rows.by.isin(["all", "state", "organ"])])
    print(table_of(table))
    seen = len(scenes[["patient", "scene"]].drop_duplicates())
    sample = f"{options.kidneys} organs, {seen} scenes; a scene counts once for each tumor"
    writer.tables({"accuracy": table}, sample=sample)


def _rows(out: Path, number: int, states: int) -> list[dict[str, Any]]:
    """A line for each scene and tumor of a kidney."""
    folder = out / str(number)
    paths, case = random_scenes(folder, number, states), load_case(folder / "case")

    def measure() -> Iterator[dict[str, Any]]:
        tracker, anatomy = scripting.tracker_of(folder / "case"), simplified(case.anatomy)
        rows = [judging.judge_folder(tracker, anatomy, path) for path in paths]
        check = described(case)
        for line in tumor_lines({"rows": rows, "check": check}):
            yield {"patient": f"kidney {number}", "slice_mm": check["slice_mm"], **line}

    code = Path(__file__), Path(judging.__file__)
    about = scripting.about_scenes(folder / "case", paths, code)
    return scripting.kept(folder / "accuracy.json", about, measure)


if __name__ == "__main__":
    scripting.run(main, Options)
