"""How well the lag and the scales of a tracked probe's images are found, and what that brings.

    make ultrasound ARGS='OUT --kidneys 2'

Makes random kidneys in OUT, their models and simulated scenes, over whose true organs a probe is
swept: forth and back (three passes), or once without turning the probe. Rows are kept, a file for
each kidney and kind of sweep; the same command goes on where it was stopped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tumortrack.core.errors import NoEstimate
from tumortrack.core.ultrasound import ImageErrors
from tumortrack.io.scene_folder import Scene, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.judging import centers_off_mm
from tumortrack_benchmarks.physics.scenes import simulated_scenes
from tumortrack_benchmarks.probe import Sweep, record
from tumortrack_benchmarks.scripting import KidneyOptions, cell

# Unit, factor and goal: 0.5 mm of a probe's way at 10 mm/s, 1 mm of 5 cm.
_LIMITS = {"lag": ("ms", 1000, 0.05), "depth": ("%", 100, 0.02), "width": ("%", 100, 0.02)}
_WIDE_MM = 5.0
_KINDS = "forth and back", "once, not turned"
_CAMERAS = "camera", "no camera"
_NOTHING_MM = np.zeros((0, 3))


@dataclass(frozen=True)
class Options(KidneyOptions):
    """Sweep, locate, compare."""

    kidneys: int = 2
    count: int = 25
    """Scenes of each."""


def main(options: Options) -> None:
    """Make missing rows, then the table."""
    writer = scripting.begun("ultrasound", options.document)
    frame = pd.DataFrame(list(_rows(options)))
    shown = table(frame)
    print(table_of(shown))
    organs = frame.case.nunique()
    writer.tables({"ultrasound": shown}, sample=f"{organs} organs, {len(frame)} answers")


def _rows(options: Options) -> Iterator[dict[str, Any]]:
    code = Path(__file__), Path(record.__code__.co_filename)
    for number in options.numbers:
        folder = options.out / str(number)
        paths, case = simulated_scenes(folder, number, options.count), folder / "case"
        about = scripting.about_scenes(case, paths, code)
        for kind in _KINDS:
            file = folder / "ultrasound" / f"{kind.split(',')[0].replace(' ', '-')}.json"
            rows = scripting.kept(file, about, partial(measured, case, paths, kind))
            yield from ({"case": str(number), "sweep": kind, **row} for row in rows)


def measured(case: Path, paths: list[Path], kind: str) -> list[dict[str, Any]]:
    """Two answers of each scene: with its cloud, and by the recording alone."""
    work = [(case, path, number, kind) for number, path in enumerate(paths)]
    return scripting.together(of_scene, work)


def of_scene(case: Path, path: Path, number: int, kind: str) -> list[dict[str, Any]]:
    tracker, scene = scripting.tracker_of(case), read_scene(path)
    rng = np.random.default_rng((number, len(kind)))
    low, high = [-0.5, -0.12, -0.05], [0.5, 0.12, 0.05]
    errors = ImageErrors(*rng.uniform(low, high).tolist())
    turned = {} if kind == _KINDS[0] else {"passes": 1, "tilt_deg": 0.0}
    sweep = Sweep(
        errors=errors, mm_per_s=rng.uniform(10, 30), hz=float(rng.choice([10, 20, 40])), **turned
    )
    recording = record(scene.reference, sweep, rng)
    return [answered(tracker, scene, errors, camera, recording) for camera in _CAMERAS]


def answered(
    tracker: Tracker, scene: Scene, errors: ImageErrors, camera: str, recording: Any
) -> dict[str, Any]:
    seen = camera == _CAMERAS[0]
    points_mm, frame = (scene.cloud.points_mm, "camera") if seen else (_NOTHING_MM, "Tracker")
    row: dict[str, Any] = {"camera": camera}
    try:
        estimate = tracker.locate(points_mm, evidence=[recording], frame=frame, grid=16)
    except NoEstimate:
        return row | {"quality": "none"}
    (probe,) = estimate.report.probes
    found = [probe.lag_s, probe.depth, probe.width]
    return row | {
        "quality": estimate.quality,
        "off_mm": max(centers_off_mm(estimate.meshes, scene.reference).values()),
        **dict(zip(("lag", "depth", "width"), np.subtract(found, errors).tolist(), strict=True)),
        "undetermined": list(probe.undetermined),
    }


def table(frame: pd.DataFrame) -> pd.DataFrame:
    """A row for each kind of sweep, with a camera and without: in how many answers lag and scales
    are known, in %, and how far off they then are, median / 95 %."""
    rows = []
    for (kind, camera), mine in frame.groupby(["sweep", "camera"], sort=False):
        answers, row = mine[mine.quality != "none"], {"sweep": kind, "": camera}
        wrong = 0
        for name, (unit, times, limit) in _LIMITS.items():
            said = answers[[name not in each for each in answers.undetermined]][name].abs()
            wrong += int((said > limit).sum())
            spread = [cell(times * said.quantile(q)) for q in (0.5, 0.95)]
            row[f"{name}, {unit}"] = f"{100 * len(said) / len(mine):.0f}: {' / '.join(spread)}"
        good = answers[answers.quality == "good"]
        spread = [cell(answers.off_mm.quantile(q)) for q in (0.5, 0.95)]
        row |= {
            "beyond the goal": str(wrong),
            "good %": f"{100 * len(good) / len(mine):.0f}",
            "farthest tumor, mm": " / ".join(spread),
            "good and over 5 mm": str(int((good.off_mm > _WIDE_MM).sum())),
        }
        rows.append(row)
    return pd.DataFrame(rows)


if __name__ == "__main__":
    scripting.run(main, Options)
