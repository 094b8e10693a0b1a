"""Every KiTS19 kidney with a tumor: the list for a fleet, and the tables of docs/population.md.

    make population ARGS='DATA --list population.csv'
    tumortrack fleet population.csv runs/population
    make population ARGS='DATA --fleet runs/population'

DATA is a folder with your copies, kits19/case_NNNNN/segmentation.nii.gz. The rule: of the 210 cases
with a label map all but those set aside for judging (00091, 00093, 00096, 00146, 00155) and those
used in development (00000, 00002, 00003), in order of their numbers; of each the kidney that
`tumortrack prepare` takes, which bears most tumor, as it comes. None is left out by hand or for its
result: what fails `prepare` or the fleet's quality check is listed as failed, with the reason.
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
from tumortrack_lab.fleet.results import LOOK, PATIENTS, SCENES
from tumortrack_lab.real.judging import quantiles
from tumortrack_lab.real.kidneys import SET_ASIDE, WHERE
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import ReportWriter, table
from tumortrack_lab.study.trust import BANDS, band_of

DEVELOPMENT = (0, 2, 3)
BLOCK = "population"
_ERRORS = "median / 90 / 95 % / worst, mm"
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
    document: Path = Path("docs/population.md")
    """Its block is replaced."""


def main(options: Options) -> None:
    """The list, the tables, or both."""
    if options.list is None and options.fleet is None:
        raise InputError("give --list FILE to make the list, or --fleet OUT for the tables of it.")
    if options.list is not None:
        maps = label_maps(options.data)[: options.count]
        lines = [f"{path.parent.name},{path.absolute()}" for path in maps]
        write_atomically(options.list, "\n".join(["name,input", *lines, ""]).encode())
        say(f"{len(lines)} kidneys listed in {options.list}.")
    if options.fleet is not None:
        writer = ReportWriter(options.document, scripts.make_command("population"))
        writer.check([BLOCK])
        image = writer.image("population")
        text = block(options.fleet, image)
        link = writer.link(image, "errors against size, depth, slices and outer share")
        writer.write({BLOCK: f"{text}\n\n{link}\n\n`{writer.command}`"})
        say(f"block written to {options.document}.")


def label_maps(data: Path) -> list[Path]:
    """The user's copies that the rule takes, in order. Raises InputError: there is none."""
    found = []
    for path in sorted((data / "kits19").glob("case_*/segmentation.nii.gz")):
        number = re.fullmatch(r"case_(\d{5})", path.parent.name)
        if number and int(number[1]) not in (*SET_ASIDE, *DEVELOPMENT):
            found.append(path)
    if not found:
        raise InputError(f"{data}/kits19 holds no label maps: put copies of {WHERE} there.")
    return found


def block(fleet: Path, image: Path) -> str:
    """The tables in Markdown; the plot goes into ``image``."""
    people, scenes = (pd.read_parquet(fleet / name) for name in (PATIENTS, SCENES))
    looks = pd.read_csv(fleet / LOOK)
    if not (people.state == "done").any():
        raise InputError(f"{fleet} has no patient that is done.")
    scenes = scenes.merge(people[["patient", "slice_mm"]], on="patient")
    draw(scenes, image)
    return "\n\n".join([_outcome(people, looks), _margins(people), _groups(scenes),
                        _wrong(scenes), _failed(people), _looks(people, looks)])  # fmt: skip


def _outcome(people: pd.DataFrame, looks: pd.DataFrame) -> str:
    """How many went through, and unattended."""
    done = people[people.state == "done"]
    alone = done[~done.patient.isin(looks.patient)]
    states = ", ".join(f"{count} {state}" for state, count in people.state.value_counts().items())
    worst = done.loc[done.middle_worst_mm.idxmax()] if done.middle_worst_mm.notna().any() else None
    said = f"Patients: {len(people)} ({states}). Everything passed unattended, so that nobody "
    said += f"needs to look: {len(alone)}, {len(alone) / len(people):.0%}. "
    said += f"Scenes: {int(done.scenes.sum())}, and {int(done.lost.sum())} that could not be made."
    if worst is not None:
        said += f" Worst good answer: {worst.patient}, {worst.middle_worst_mm:.1f} mm."
    return said


def _margins(people: pd.DataFrame) -> str:
    """What so few states say, and whether it held."""
    done = people[(people.state == "done") & people.within_largest.notna()]
    if done.empty:
        return "Margins: no patient has good answers to both kinds of states."
    return (
        f"Margins: the largest miss over a patient's margin states, {_ERRORS}: "
        f"{quantiles(done.largest_miss_mm)}. Another such answer misses by no more in "
        f"{done.holds_for.mean():.0%} (n / (n + 1), mean); of the scenes evaluated, which are "
        f"other states, {done.within_largest.mean():.0%} did."
    )


def _groups(scenes: pd.DataFrame) -> str:
    """Verdicts and errors, by what was done to the organ and how tumors lie."""
    given: dict[str, pd.Series] = {"all": pd.Series("all", scenes.index), "state": scenes.family}
    bands = pd.Categorical(scenes.hidden_share.map(band_of), BANDS)
    given["hidden"] = pd.Series(bands, scenes.index)
    given |= {"kind": scenes.kind, "at": scenes.position}
    for column, (words, limits) in _AGAINST.items():
        given[words] = pd.cut(scenes[column], limits, right=False)
    head = ["", "tumors", "scenes", "good, poor, refused", f"centre, {_ERRORS}", "best rigid pose"]
    head += ["Hausdorff", "best rigid pose", "over 3, 5 mm"]
    body = []
    for words, values in given.items():
        for value, mine in scenes.groupby(values, observed=True):
            good = mine[mine.verdict == "good"]
            shares = [
                f"{(mine.verdict == name).mean():.0%}" for name in ("good", "poor", "refused")
            ]
            body.append([
                value if words == "all" else f"{words}: {value}",
                str(mine.groupby(["patient", "tumor"]).ngroups), str(len(mine)), ", ".join(shares),
                quantiles(good.middle_mm), quantiles(good.rigid_middle_mm),
                quantiles(good.hausdorff_mm), quantiles(good.rigid_hausdorff_mm),
                f"{int(good.over_3_mm.sum())}, {int(good.over_5_mm.sum())}",
            ])  # fmt: skip
    return "Errors of answers called good, and of the best rigid pose of the same scenes; a " + (
        f"scene counts once a tumor.\n\n{table(head, body)}"
    )


def _wrong(scenes: pd.DataFrame) -> str:
    """Every answer called good and over 5 mm off."""
    wrong = scenes[scenes.over_5_mm.astype(bool)].sort_values("middle_mm", ascending=False)
    named = [
        f"{row.patient} {row.scene} {row.tumor} {row.middle_mm:.1f} ({row.rigid_middle_mm:.1f})"
        for row in wrong.itertuples()
    ]
    return f"Called good and over 5 mm off (best rigid pose): {'; '.join(named) or 'none'}."


def _failed(people: pd.DataFrame) -> str:
    failed = people[people.state.isin(["cannot", "failed"])]
    rows = [[row.patient, row.step, row.reason] for row in failed.itertuples()]
    head = ["failed", "step", "reason"]
    return table(head, rows, 3) if rows else "Nobody failed."


def _looks(people: pd.DataFrame, looks: pd.DataFrame) -> str:
    done = looks[looks.patient.isin(people[people.state == "done"].patient)]
    rows = [[name, "; ".join(mine.reason)] for name, mine in done.groupby("patient")]
    head = ["for a person's eye", "why"]
    return table(head, rows, 2) if rows else "Nobody else needs a person's eye."


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
    scripts.run(main, Options)
