"""With which noise, cameras and distances are answers still good, and how far off are tumors?

    make noise ARGS='OUT CASE=SCENES ...'

CASE: a folder with its model; SCENES: of `tumortrack simulate`, whose true organs are seen again
under every condition, with the same seeds. Clouds are the organ's, and not searched for it. Rows
are kept in OUT, a file for each case and condition; the same command goes on where it was stopped.
The page's are random kidneys by their number (`world.kidneys.random_anatomy`), prepared, with
`tumortrack.write_scenes(CASE, SCENES, scenes=16, seed=77, elastic=True)`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import pandas as pd
import tyro
from matplotlib.lines import Line2D

import tumortrack.sense
from tumortrack.cli.console import model_folder, say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.report import drawing
from tumortrack.sense.sensors import FIGURES
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.study import noise, scripts
from tumortrack_lab.study.document import share_words, table_of
from tumortrack_lab.study.methods import code_sha256
from tumortrack_lab.study.noise import Condition
from tumortrack_lab.study.tables import NOTHING, ordered

_WIDE_MM = 5.0
_CONDITIONS = (
    "white:0", "white:0.5", "white:1", "white:2",
    "correlated:0.5:3", "correlated:1:3", "correlated:2:3",
    "correlated:0.5:8", "correlated:1:8", "correlated:2:8",
    "d405-measured@150", "d405-measured@300", "d405-measured@500", "d405-measured:0@500",
    "d435@300", "zed@400", "zed:0@400", "azure-kinect@400", "structured-light@500",
    "scale:3", "depth:4", "uncalibrated-d405-measured@150", "uncalibrated-d405-measured@300",
    "uncalibrated-d435@300", "uncalibrated-azure-kinect@400", "uncalibrated-structured-light@500",
    "cloud:1", "cloud:2", "strays:20", "strays:40", "fat:15",
)  # fmt: skip
_COLUMNS = ["case", "condition", "quality", "check", "off_mm", "rigid_mm", "beyond", "seconds"]


@dataclass(frozen=True)
class Options:
    """Disturb, locate, compare."""

    out: tyro.conf.Positional[Path]
    """Where rows are kept."""
    cases: tyro.conf.Positional[tuple[str, ...]]
    """CASE=SCENES: a case with its model, and a folder of scenes of it."""
    conditions: tuple[str, ...] = _CONDITIONS
    """white:MM, correlated:MM:PX, cloud:MM, strays:%, fat:%, scale:%, depth:MM, CAMERA,
    uncalibrated-CAMERA, or CAMERA:TIMES its noise, and
    from where: @MM."""
    count: int = 16
    """Scenes of each case, at most."""
    document: Path | None = None
    """A page that shows the table, which goes beside it."""


def main(options: Options) -> None:
    """Make missing rows, then table and picture."""
    writer = scripts.begun("noise", options.document)
    frame = pd.DataFrame(list(_rows(options)), columns=_COLUMNS)
    shown = table(frame)
    print(table_of(shown))
    good = frame[frame.quality == "good"]
    wide = share_words(int((good.off_mm > _WIDE_MM).sum()), len(good)) if len(good) else NOTHING
    sample = f"{frame.case.nunique()} organs, {len(frame)} images and clouds"
    writer.tables({"noise": shown}, sample=sample, interval=f"over 5 mm {wide} of good")
    if options.document is not None:
        draw(frame, writer.image("noise"))


def _rows(options: Options) -> Iterator[dict[str, Any]]:
    """Of all cases and conditions."""
    conditions = {text: Condition.read(text) for text in options.conditions}
    sensors = Path(tumortrack.sense.__path__[0]) / "sensors.toml"
    code = code_sha256([Path(noise.__file__), sensors])
    for number, pair in enumerate(options.cases):
        case, equals, folder = pair.partition("=")
        if not equals:
            raise InputError(f"{pair} is not CASE=SCENES.")
        name, paths = Path(case).name, tuple(list_scenes(Path(folder))[: options.count])
        about = {"code": code, "scenes": [store.sha256_of(path) for path in paths]}
        about |= {"case": store.sha256_of(Path(case) / store.MANIFEST)}
        for done, (text, condition) in enumerate(conditions.items(), number * len(conditions)):
            file = options.out / name / f"{text.replace(':', '-')}.json"
            at = f"{done + 1}/{len(options.cases) * len(conditions)} {name} {text}"
            measure = partial(_measured, Path(case), paths, condition, at)
            rows = scripts.kept(file, about | {"condition": text}, measure)
            yield from ({"case": name, "condition": text, **row} for row in rows)


def _measured(
    case: Path, paths: tuple[Path, ...], condition: Condition, at: str
) -> list[dict[str, Any]]:
    ready, start = _ready(case, paths), time.monotonic()
    rows = noise.measured(*ready, condition)
    say(f"{at}: {len(rows) / (time.monotonic() - start):.1f} answers a second")
    return rows


@cache
def _ready(case: Path, paths: tuple[Path, ...]) -> tuple[Tracker, list[Scene]]:
    """Read where something is to be measured."""
    return Tracker(load_model(model_folder(case))), [read_scene(path) for path in paths]


def table(frame: pd.DataFrame) -> pd.DataFrame:
    """A line for each condition."""
    frame, lines = ordered(frame, ["condition"]), []
    for text, rows in frame.groupby("condition", observed=True):
        condition, good = Condition.read(text), rows[rows.quality == "good"]
        answers = rows[rows.quality != "none"]
        share, interval = share_words(len(good), len(rows)).rstrip(")").split(" % (")
        lines.append({
            "noise": condition.name, "at mm": f"{condition.distance_mm:g}",
            "depth's noise mm": f"{condition.noise_mm:.1f}", "scenes": len(rows),
            "good %": share, "its 95 % interval": interval,
            "no answer": len(rows) - len(answers),
            "worst tumor off mm: median": _text(answers.off_mm.median()),
            "95 %": _text(answers.off_mm.quantile(0.95)),
            "95 % of good": _text(good.off_mm.quantile(0.95)),
            "rigid fit: median": _text(answers.rigid_mm.median()),
            "its 95 %": _text(answers.rigid_mm.quantile(0.95)),
            "good, over 5 mm": int((good.off_mm > _WIDE_MM).sum()),
            "good, beyond its bound": int(good.beyond.eq(True).sum()),
            "median s": f"{rows.seconds.median():.1f}",
        })  # fmt: skip
    return pd.DataFrame(lines)


def _text(value: float) -> str:
    return NOTHING if pd.isna(value) else f"{value:.1f}"


def draw(frame: pd.DataFrame, path: Path) -> None:
    """Good answers and median errors, of rigid fits dashed, against noise and for cameras."""
    of = {text: Condition.read(text) for text in frame.condition.unique()}
    figure = drawing.new_figure(8.0, 5.8, left=0.08, right=0.98, top=0.92, bottom=0.25)
    (good, other), (off, off_other) = figure.subplots(2, 2, sharey="row")
    groups = frame.groupby("condition")
    share = 100 * groups.quality.agg(lambda quality: (quality == "good").mean())
    lines, errors = [], groups[["off_mm", "rigid_mm"]].median()
    for number, (kind, px) in enumerate((("white", 0), ("correlated", 3), ("correlated", 8))):
        at_150 = [(c.amount, text, c) for text, c in of.items() if c.distance_mm == 150]
        known = [(mm, t) for mm, t, c in at_150 if (c.kind, c.length_px) == (kind, px)]
        none = [(mm, t) for mm, t, c in at_150 if c.name == "none"]
        mm, texts = zip(*sorted({*none, *known}), strict=True) if none or known else ((), ())
        style = {"color": f"C{number}", "marker": "o", "markersize": 4}
        lines += good.plot(mm, share[[*texts]], label=f"{kind}, {px} px" if px else kind, **style)
        off.plot(mm, errors.off_mm[[*texts]], **style)
        off.plot(mm, errors.rigid_mm[[*texts]], "--", color=f"C{number}", linewidth=1)
    cameras = [t for t, c in of.items() if c.kind in FIGURES and c.amount == 1]
    cameras = [text for text in cameras if not of[text].uncalibrated]
    names = [f"{of[text].name}, {of[text].distance_mm:g} mm" for text in cameras]
    for axes, values in ((other, share), (off_other, errors.off_mm)):
        axes.plot(range(len(cameras)), values[cameras], "o", color="0.2")
        axes.set_xticks(range(len(cameras)), names, rotation=35, ha="right", fontsize=8)
    off_other.plot(range(len(cameras)), errors.rigid_mm[cameras], "_", color="0.2", markersize=11)
    for axes in (good, other, off, off_other):
        axes.grid(color="0.9")
        axes.set_ylim(0, 103 if axes in (good, other) else None)
        axes.tick_params(labelbottom=axes in (off, off_other))
    good.set_ylabel("good answers, %")
    off.set(xlabel="noise of a depth at 150 mm, mm", ylabel="tumor off, median, mm")
    lines.append(Line2D([], [], color="0.2", linestyle="--", label="rigid fit (dashed, or a bar)"))
    drawing.show_legend(figure, lines, 4, (0.98, 1.0))
    drawing.save(figure, path)


if __name__ == "__main__":
    scripts.run(main, Options)
