"""Every KiTS19 kidney with a tumor: the list for a fleet, and the tables of what came of it.

    make population ARGS='DATA --list population.csv'
    tumortrack fleet population.csv runs/population
    make population ARGS='DATA --fleet runs/population'

DATA is a folder with your copies, kits19/case_NNNNN/segmentation.nii.gz. The rule: of the 210 cases
with a label map all but those set aside for judging (00091, 00093, 00096, 00146, 00155) and those
used in development (00000, 00002, 00003), in order of their numbers; of each the kidney that
`tumortrack prepare` takes, the one with most tumor. None is left out by hand or for its result:
what fails `prepare` or the fleet's quality check is listed as failed, with the reason.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro

from tumortrack.cli.console import say
from tumortrack.core.errors import InputError
from tumortrack.core.store import write_atomically
from tumortrack.report import drawing
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import ReportWriter, beside_rigid, share_words, spread_mm
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
    """Make the list of a population, or the tables of a finished run over it."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of your own copies of the data."""
    list: Path | None = None
    """Write the list for `tumortrack fleet` here."""
    count: int | None = None
    """Only the first so many."""
    fleet: Path | None = None
    """Folder that `tumortrack fleet` wrote."""
    document: Path = Path("docs/results.md")
    """A page that shows the tables, which go beside it with the plots."""


def main(options: Options) -> None:
    """The list, the tables, or both."""
    if options.list is None and options.fleet is None:
        raise InputError("give --list FILE to make the list, or --fleet OUT for the tables of it.")
    if options.list is not None:
        maps = label_maps(options.data)[: options.count]
        lines = [f"{path.parent.name},{path.absolute()},1" for path in maps]
        head = "name,input,margin_states"  # one state: the least
        write_atomically(options.list, "\n".join([head, *lines, ""]).encode())
        say(f"{len(lines)} kidneys listed in {options.list}.")
    if options.fleet is not None:
        writer = scripting.begun("population", options.document)
        fill(options.fleet, writer)
        say(f"written to {options.document}.")


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
    scenes = scenes.reindex(columns=[*dict.fromkeys([*scenes, *ERRORS.values(), "radius_mm"])])
    draw(scenes, writer.image(BLOCK))
    rows, alone = grouped(scenes), len(done[~done.patient.isin(views.patient)])
    sample = (
        f"{len(people)} patients, {len(done)} done, {alone} with nothing for a person to look at, "
        f"{int(done.scenes.sum())} scenes, {int(done.lost.sum())} more could not be made"
    )
    short = rows[rows.by.isin(["all", "state"])]
    more = {"over 5 mm": "over 5 mm", "of good": "good within radius %"}
    more["rank correlation"] = "rank correlation"
    shown = short[["value", "scenes", "good %"]].assign(**beside_rigid(short))
    short = shown.join(short[[*more]].rename(columns=more))
    good = scenes[scenes.verdict == "good"]
    share = share_words(int(good.over_5_mm.sum()), len(good)) if len(good) else "none"
    tables = {"": short, "-groups": rows, "-wrong": wrong(scenes), "-look": views}
    tables = {f"{BLOCK}{name}": table for name, table in tables.items()}
    writer.tables(tables, sample=sample, interval=f"over 5 mm {share} of good")


def grouped(scenes: pd.DataFrame) -> pd.DataFrame:
    """Verdicts and errors by load and by tumor; a scene counts once for each tumor."""
    limits = [-np.inf, *_HIDDEN.values()]
    bands = pd.cut(scenes.hidden_share, limits, labels=[*_HIDDEN])
    given = {"all": pd.Series("all", scenes.index), "state": scenes.family}
    given |= {"hidden": bands, "kind": scenes.kind, "at": scenes.position}
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
            row |= {f"over {mm} mm": int(good[f"over_{mm}_mm"].sum()) for mm in (3, 5)}
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
