"""How well the lag and the scales of a tracked probe's images are found, and what that brings.

    make ultrasound ARGS='OUT CASE=SCENES ...'

CASE: a folder with its model; SCENES: of `tumortrack simulate`, over whose true organs a probe is
swept: forth and back (three passes), or once without turning the probe. Rows are kept in OUT, a
file for each case and kind of sweep; the same command goes on where it was stopped.
The page's are the random kidneys 101 and 102 (`physics.kidneys.random_anatomy`), prepared, with
`tumortrack.write_scenes(CASE, SCENES, scenes=25, seed=77, elastic=True)`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.ultrasound import ImageErrors
from tumortrack.io.scene_folder import Scene, list_scenes, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.probe import Sweep, record
from tumortrack_benchmarks.scripting import cell

# Unit, factor and goal: 0.5 mm of a probe's way at 10 mm/s, 1 mm of 5 cm.
_LIMITS = {"lag": ("ms", 1000, 0.05), "depth": ("%", 100, 0.02), "width": ("%", 100, 0.02)}
_WIDE_MM = 5.0
_KINDS = "forth and back", "once, not turned"
_CAMERAS = "camera", "no camera"
_NOTHING_MM = np.zeros((0, 3))


@dataclass(frozen=True)
class Options:
    """Sweep, locate, compare."""

    out: tyro.conf.Positional[Path]
    """Where rows are kept."""
    cases: tyro.conf.Positional[tuple[str, ...]]
    """CASE=SCENES: a case with its model, and a folder of scenes of it."""
    count: int = 50
    """Scenes of each case, at most."""
    document: Path | None = None
    """A page that shows the table, which goes beside it."""


def main(options: Options) -> None:
    """Make missing rows, then the table."""
    writer = scripting.begun("ultrasound", options.document)
    frame = pd.DataFrame(list(_rows(options)))
    shown = table(frame)
    print(table_of(shown))
    organs = frame.case.nunique()
    writer.tables({"ultrasound": shown}, sample=f"{organs} organs, {len(frame)} answers")


def _rows(options: Options) -> Iterator[dict[str, Any]]:
    code = scripting.code_sha256([Path(__file__), Path(record.__code__.co_filename)])
    for pair in options.cases:
        case, equals, folder = pair.partition("=")
        if not equals:
            raise InputError(f"{pair} is not CASE=SCENES.")
        paths = list_scenes(Path(folder))[: options.count]
        about = {"code": code, "scenes": [store.sha256_of(path) for path in paths]}
        about |= {"case": store.sha256_of(Path(case) / store.MANIFEST)}
        for kind in _KINDS:
            file = options.out / Path(case).name / f"{kind.split(',')[0].replace(' ', '-')}.json"
            measure = partial(measured, Path(case), paths, kind)
            rows = scripting.kept(file, about, measure)
            say(f"{Path(case).name}, {kind}: {len(rows)} answers")
            yield from ({"case": Path(case).name, "sweep": kind, **row} for row in rows)


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
    tumors = {name: estimate.meshes[name].box_mm.mean(0) for name in estimate.report.tumors}
    true = dict(zip(scene.reference.names, scene.reference.parts, strict=True))
    off_mm = max(float(np.linalg.norm(at - true[n].box_mm.mean(0))) for n, at in tumors.items())
    return row | {
        "quality": estimate.quality,
        "off_mm": off_mm,
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
