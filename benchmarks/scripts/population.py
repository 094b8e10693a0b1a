"""Every KiTS19 kidney with a tumor: the list for a fleet, and the tables of what came of it.

    make population ARGS='DATA OUT --document docs/results.md'

It makes the list of a `tumortrack fleet` in OUT, and runs that on this machine; the same command
goes on where it was stopped. DATA is a folder with your copies,
kits19/case_NNNNN/segmentation.nii.gz. The rule: of the 210 cases with a label map all but those set
aside for judging (00091, 00093, 00096, 00146, 00155) and those used in development (00000, 00002,
00003), in order of their numbers; of each the kidney that `tumortrack prepare` takes, the one with
most tumor. None is left out by hand or for its result: what fails `prepare` or the fleet's quality
check is listed as failed, with the reason.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro

from tumortrack.core.errors import InputError
from tumortrack.core.store import write_atomically
from tumortrack.report import drawing
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.cli.fleet import Fleet
from tumortrack_benchmarks.document import (
    ReportWriter,
    beside_rigid,
    make_folder,
    share_words,
    spread_mm,
    spread_words,
)
from tumortrack_benchmarks.fleet.results import LOOK, PATIENTS, SCENES

SET_ASIDE, DEVELOPMENT = (91, 93, 96, 146, 155), (0, 2, 3)
WHERE = "data/case_NNNNN/segmentation.nii.gz of https://github.com/neheller/kits19"
_HIDDEN = {"nothing hidden": 0.0, "up to 40 %": 0.4, "over 40 %": np.inf}  # of the surface
BLOCK = "population"
ERRORS = {
    "centre": "middle_mm",
    "best rigid pose's centre": "rigid_middle_mm",
    "Hausdorff": "hausdorff_mm",
    "best rigid pose's Hausdorff": "rigid_hausdorff_mm",
    "rigid fit's centre": "rigid_fit_middle_mm",
    "rigid fit's Hausdorff": "rigid_fit_hausdorff_mm",
}
# What errors are shown against: a column, its words, the limits of groups.
_AGAINST: dict[str, tuple[str, tuple[float, ...]]] = {
    "ml": ("tumor, ml", (0, 4, 14, 33, np.inf)),  # balls of 2, 3 and 4 cm
    "depth_mm": ("its middle below the surface, mm", (0, 5, 10, 20, np.inf)),
    "slice_mm": ("thickest voxel edge, mm", (0, 1.01, 3.01, np.inf)),
    "outer_share": ("outer share of its surface", (0, 0.25, 0.5, 1.01)),
}
_SHOWN = {
    "rigid_middle_mm": ("0.6", "best rigid pose"),
    "middle_mm": ("C1", "located: median, 95th percentile"),
}


@dataclass(frozen=True, kw_only=True)
class Options:
    """Run a fleet over a population, and make its tables."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of your own copies of the data."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the fleet and of its list."""
    count: int | None = None
    """Only the first so many."""
    document: Path | None = None
    """A page that shows the tables, which go beside it with the plots."""


def main(options: Options) -> None:
    """The list, the fleet, the tables."""
    writer = scripting.begun("population", options.document, {str(options.data): "DATA"})
    listed, maps = options.out / "population.csv", label_maps(options.data)[: options.count]
    lines = [f"{path.parent.name},{path.absolute()},1" for path in maps]
    head = "name,input,margin_states"  # one state: the least
    make_folder(options.out)
    write_atomically(listed, "\n".join([head, *lines, ""]).encode())
    Fleet(list=listed, out=options.out).run()
    if options.document is not None:
        fill(options.out, writer)


def label_maps(data: Path) -> list[Path]:
    """The user's copies that the rule selects, in order. Raises InputError: there is none."""
    paths = []
    for path in sorted((data / "kits19").glob("case_*/segmentation.nii.gz")):
        number = re.fullmatch(r"case_(\d{5})", path.parent.name)
        if number and int(number[1]) not in (*SET_ASIDE, *DEVELOPMENT):
            paths.append(path)
    if not paths:
        raise InputError(f"{data}/kits19 holds no label maps: put copies of {WHERE} there.")
    return paths


def fill(fleet: Path, writer: ReportWriter) -> None:
    """The document's tables and pictures."""
    people, scenes = (pd.read_parquet(fleet / name) for name in (PATIENTS, SCENES))
    views = pd.read_csv(fleet / LOOK)
    done = people[people.state == "done"]
    if done.empty:
        raise InputError(f"{fleet} has no patient that is done.")
    scenes = scenes.merge(people[["patient", "slice_mm"]], on="patient")
    draw(scenes, writer.image(BLOCK))
    rows, alone = grouped(scenes), len(done[~done.patient.isin(views.patient)])
    sample = (
        f"{len(people)} patients, {len(done)} done, {alone} with nothing for a person to look at, "
        f"{int(done.scenes.sum())} scenes, {int(done.lost.sum())} more could not be made"
    )
    short = shown(rows[rows.by.isin(["all", "state"])])
    tables = {"": short, "-groups": rows, "-wrong": wrong(scenes), "-look": views}
    tables = {f"{BLOCK}{name}": table for name, table in tables.items()}
    interval = f"over 5 mm {rows['over 5 mm, % of good'].iloc[0]} of good"
    writer.tables(tables, sample=sample, interval=interval)


def shown(rows: pd.DataFrame) -> pd.DataFrame:
    """The columns of ``grouped`` for a page."""
    more = {"over 5 mm": "over 5 mm", "of good": "good within radius %"}
    more |= {name: name for name in ("rank correlation", "over 5 mm, % of good")}
    short = rows[["value", "scenes", "good %"]].assign(**beside_rigid(rows))
    short = short.join(rows[[*more]].rename(columns=more))
    return short.assign(**{"also poor answers": spread_words(rows, "any centre")})


def grouped(scenes: pd.DataFrame, **more: pd.Series) -> pd.DataFrame:
    """Verdicts and errors by load and by tumor, and by what ``more`` says of scenes; a scene counts
    once for each tumor. Errors are those of good answers."""
    scenes = scenes.reindex(columns=[*dict.fromkeys([*scenes, *ERRORS.values(), "radius_mm"])])
    limits = [-np.inf, *_HIDDEN.values()]
    bands = pd.cut(scenes.hidden_share, limits, labels=[*_HIDDEN])
    given = {"all": pd.Series("all", scenes.index), "state": scenes.family}
    given |= more | {"hidden": bands, "kind": scenes.kind, "at": scenes.position}
    for column, (words, limits) in _AGAINST.items():
        given[words] = pd.cut(scenes[column], limits, right=False)
    rows = []
    for by, values in given.items():
        for value, mine in scenes.groupby(values, observed=True):
            good = mine[mine.verdict == "good"]
            row = {"by": by, "value": value, "scenes": len(mine)}
            row["tumors"] = mine.groupby(["patient", "tumor"]).ngroups
            for verdict in ("good", "poor", "refused"):
                row[f"{verdict} %"] = f"{100 * (mine.verdict == verdict).mean():.0f}"
            for words, column in ERRORS.items():
                row |= spread_mm(words, good[column])
            row |= spread_mm("any centre", mine.middle_mm)
            row |= {f"over {mm} mm": int(good[f"over_{mm}_mm"].sum()) for mm in (3, 5)}
            far = int(good.over_5_mm.sum()), len(good)
            row["over 5 mm, % of good"] = share_words(*far) if len(good) else scripting.NOTHING
            said = mine.dropna(subset=["radius_mm"])
            row |= {
                "within radius %": f"{100 * (said.middle_mm <= said.radius_mm).mean():.0f}",
                "of good": f"{100 * (good.middle_mm <= good.radius_mm).mean():.0f}",
                "rank correlation": f"{said.middle_mm.corr(said.radius_mm, method='spearman'):.2f}",
            }
            rows.append(row)
    return pd.DataFrame(rows)


def wrong(scenes: pd.DataFrame) -> pd.DataFrame:
    """Every answer called good and over 5 mm off, the worst first."""
    shown = {"middle_mm": "centre mm", "rigid_middle_mm": "best rigid pose mm"}
    shown["rigid_fit_middle_mm"] = "rigid fit mm"
    some = scenes[scenes.over_5_mm.astype(bool)].sort_values("middle_mm", ascending=False)
    return some[["patient", "scene", "tumor", *shown]].rename(columns=shown).round(1)


def draw(scenes: pd.DataFrame, path: Path) -> None:
    """A point a tumor: the median error of its good answers, a line to their 95th percentile;
    beside it the best rigid pose's."""
    good = scenes[scenes.verdict == "good"]
    figure = drawing.new_figure(10.0, 7.0, left=0.07, right=0.99, top=0.93, bottom=0.08)
    for number, (column, (words, _)) in enumerate(_AGAINST.items(), start=1):
        axes = figure.add_subplot(2, 2, number)
        for name, (color, label) in _SHOWN.items():
            of = good.groupby(["patient", "tumor"])
            at, errors = of[column].first(), of[name]
            axes.vlines(at, errors.median(), errors.quantile(0.95), color=color, alpha=0.3)
            axes.plot(at, errors.median(), "o", color=color, markersize=4, label=label)
        axes.set_xscale("log" if column == "ml" else "linear")
        axes.set(xlabel=words, ylabel="" if number % 2 == 0 else "error of the centre, mm")
        axes.set_ylim(0, None)
    figure.axes[0].legend(frameon=False, fontsize=9)
    drawing.save(figure, path)


if __name__ == "__main__":
    scripting.run(main, Options)
