"""Plans and cuts in tables: pooled, and each case by itself."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tumortrack_lab.study.figures import names, pick
from tumortrack_lab.study.markdown import table
from tumortrack_lab.study.resection import MARGIN_MM, PLANNERS, SIGMAS, TRUTH, Planner

WHOLE = 0.999  # of a tumor: what is missing is a voxel's rounding
_HEAD = (
    "located by", "planner", "plans", "piece comes free", "tumor whole in the piece",
    "tumor removed, %: median", "worst", "tumor left, ml: worst",
    "margin kept, mm: median", "worst", "healthy tissue, ml: mean",
)  # fmt: skip
_NOTHING = "–"
_LEFT = 2
RULE = (
    "Each exophytic tumor (one whose own surface is the organ's over 5 % or more, in the CT) of "
    "each scene is planned on the estimate, and the plan is carried out on the true organ of that "
    "scene, as in `evaluate/resection.py`: voxels of 0.5 mm, severed only where a stroke or a "
    "level sheet passes. Removed is what comes away within the piece that the strokes enclose: "
    "what stays, or falls off beside it, is left; a piece that still hangs by 2 mm² of tissue or "
    f"more has not come free, and nothing of it is removed. Whole: {100 * WHOLE:g} % or more. "
    "Margin kept: least distance from the cut's surface within tissue to the true tumor; negative: "
    "so deep did the cut go into it. Healthy tissue: with the pieces that came free. Numbers are "
    "of the plans that were made, tumors' shares rounded down. Truth: planned on the true organ, "
    f"the bound. Margins are {MARGIN_MM:g} mm; “+ {SIGMAS:g} sd”: and {SIGMAS:g} standard "
    "deviations of the estimate more, at each place of the tumor's surface; with the paper's "
    "planner, which has one margin, as many as the least certain place needs. Left out: tissue "
    "does not move or give way while it is cut, nobody pulls at the piece, the instrument takes "
    "no tissue with it, and it reaches all of a level sheet below the piece, of which the paper's "
    "planner gives the outline alone."
)


@dataclass(frozen=True)
class ResectionRow:
    """One planner on the estimates of one method: the entries of its plans, made or refused."""

    method: str
    planner: Planner
    entries: list[dict]

    @property
    def made(self) -> list[dict]:
        return [entry for entry in self.entries if "refused" not in entry]

    def texts(self) -> list[str]:
        made = self.made
        free = sum(entry["detached"] for entry in made)
        whole = sum(entry["removed_share"] >= WHOLE for entry in made)
        removed = [100 * entry["removed_share"] for entry in made]
        margins = [entry["margin_mm"] for entry in made if entry["margin_mm"] is not None]
        return [
            self.method,
            planner_text(self.planner),
            f"{len(made)} of {len(self.entries)}",
            f"{free} of {len(made)}",
            f"{whole} of {len(made)}",
            _of(removed, np.median, down=True),
            _of(removed, min, down=True),
            _of([entry["left_ml"] for entry in made], max, digits=2),
            _of(margins, np.median),
            _of(margins, min),
            _of([entry["healthy_ml"] for entry in made if entry["detached"]], np.mean),
        ]


def planner_text(planner: Planner) -> str:
    whose = "the paper's" if planner.method == "published" else "ours"
    more = f" + {planner.sigmas:g} sd" if planner.sigmas else ""
    return f"{whose}, {planner.margin_mm:g} mm{more}"


def tables_of(cells: list[dict]) -> str:
    """Pooled over the cases; each case; and why there was no plan, where there was none."""
    texts = ["All cases:", table(_HEAD, [row.texts() for row in rows_of(cells)], left=_LEFT)]
    cases = names(cells, "case")
    if len(cases) > 1:
        each = [
            [case if number == 0 else "", *row.texts()]
            for case in cases
            for number, row in enumerate(rows_of(pick(cells, case=case)))
        ]
        texts += ["Each case:", table(("case", *_HEAD), each, left=_LEFT + 1)]
    return "\n\n".join([*texts, _refused(cells), *_hurt(cells)])


def rows_of(cells: list[dict]) -> list[ResectionRow]:
    """In the order of methods, the truth last, and of planners."""
    methods = sorted(names(cells, "method"), key=lambda name: name == TRUTH)
    rows = []
    for method in methods:
        plans = [plans for cell in pick(cells, method=method) for plans in cell["plans"].values()]
        for planner in PLANNERS:
            entries = [plan[planner.name] for plan in plans if planner.name in plan]
            if entries:
                rows.append(ResectionRow(method, planner, entries))
    return rows


def _refused(cells: list[dict]) -> str:
    reasons: Counter[str] = Counter()
    for row in rows_of(cells):
        for entry in row.entries:
            if "refused" in entry:
                reasons[f"{row.method}, {planner_text(row.planner)}: {entry['refused']}"] += 1
    if not reasons:
        return "No plan was refused."
    return "Refused: " + " ".join(f"{count} x {why}" for why, count in reasons.items())


def _hurt(cells: list[dict]) -> list[str]:
    """Other tumors that a cut went into."""
    count = sum(bool(entry["hurt"]) for row in rows_of(cells) for entry in row.made)
    total = sum(len(row.made) for row in rows_of(cells))
    return [f"Cuts into another tumor: {count} of {total}."]


def _of(
    values: list[float],
    take: Callable[[list[float]], float],
    digits: int = 1,
    down: bool = False,
) -> str:
    if not values:
        return _NOTHING
    value = float(take(values))
    if down:
        value = math.floor(round(value * 10**digits, 6)) / 10**digits
    return f"{value + 0.0:.{digits}f}"
