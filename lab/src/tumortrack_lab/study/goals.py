"""The goals, with what was measured beside each: the paper, peers, our presets, the bounds.

Every number is first averaged over the seeds of networks (none where one seed has none), then
taken over variants and cases. Whether a goal is met is decided by the exact number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from tumortrack_lab.study.figures import NOT_FOUND, median, names, pick
from tumortrack_lab.study.markdown import table
from tumortrack_lab.study.models import CLINIC
from tumortrack_lab.study.paper import Kind, Lie, hausdorff
from tumortrack_lab.study.tables import EMPTY, carries, label_of, target_error

Lies = dict[str, dict[str, Lie]]  # by case and tumor
Read = Callable[[list[dict]], float | None]

RULE = (
    "Distances in mm. Medians over cases and variants (and tumors, where a case has several), "
    "numbers of networks averaged over their seeds before; a part that was not found counts as "
    "infinitely far. Deformed variants are those that are neither turned only nor at rest. HD is "
    "the symmetric distance, one-sided the paper's, from the estimate to the truth. Numbers of "
    f"{CLINIC} are rounded to its disadvantage, and its goals judged by the unrounded ones. Hidden "
    "surface: median error with 40 % of the visible surface hidden over the median error without, "
    "both on clean depth. Bounds: our elastic body fitted to the true places of the visible "
    "surface, and of all surfaces, in least squares: a single distance may come out below them. "
    "Training: the longest of the models, by the wall clock of a machine with the load said here, "
    "without the seconds that building the elastic body takes; for the surface fit its preparation."
)
_UPRIGHT = "D0"
_TURNED = "Rot"
_GOALS_MM = {"exophytic": (1.5, 2.0, 3.0), "endophytic": (2.0, 3.0, 4.0)}
_TRAINING_MIN = {"cpu": 15.0, "H100": 2.0}  # by device
_NOTHING = "–"


@dataclass(frozen=True)
class StudyGoal:
    """One figure: how it is read from one method's cells, and what it should be at most (or at
    least, ``high``)."""

    text: str
    read: Read
    limit: float | None = None
    paper: str = EMPTY
    high: bool = False

    def verdict(self, cells: list[dict]) -> str:
        """``yes`` or ``no``; nothing where nothing was measured or there is no goal."""
        if self.limit is None or not self.measured(cells):
            return _NOTHING
        value = self.read(cells)
        if value is None:
            return "no"
        return "yes" if (value >= self.limit if self.high else value <= self.limit) else "no"

    def measured(self, cells: list[dict]) -> bool:
        try:
            self.read(cells)
        except LookupError:
            return False
        return True

    def value(self, cells: list[dict], ours: bool) -> str:
        """The number, to two digits; ``ours``: rounded to its disadvantage."""
        if not self.measured(cells):
            return _NOTHING
        value = self.read(cells)
        if value is None:
            return NOT_FOUND
        if ours:
            away = math.floor if self.high else math.ceil
            value = away(round(value * 100, 6)) / 100
        return f"{value:.2f}"


def tables_of(cells: list[dict], lies: Lies) -> str:
    """The goals with every method, then each case by itself."""
    goals = goals_of(cells, lies)
    methods = names(cells, "method")
    own = pick(cells, method=CLINIC)
    before = [name for name in methods if name != CLINIC and "bound" not in name]
    bounds = [name for name in methods if "bound" in name]
    head = ["figure", "paper", *map(label_of, before), CLINIC, "goal", "met"]
    rows = []
    for goal in goals:
        row = [goal.text, goal.paper]
        row += [goal.value(pick(cells, method=name), ours=False) for name in before]
        row += [goal.value(own, ours=True), _limit(goal), goal.verdict(own)]
        row += [goal.value(pick(cells, method=name), ours=False) for name in bounds]
        rows.append(row)
    whole = table([*head, *map(label_of, bounds)], rows)
    cases = names(own, "case")
    each = [
        [goal.text, *(_with_verdict(goal, pick(own, case=case)) for case in cases)]
        for goal in goals
    ]
    return f"{whole}\n\nEach case of {CLINIC}:\n\n{table(['figure', *cases], each)}"


def goals_of(cells: list[dict], lies: Lies) -> list[StudyGoal]:
    """Every goal, as it is read from these cells' kind."""
    goals = []
    kinds: tuple[Kind, ...] = ("exophytic", "endophytic")
    for kind in kinds:
        for variant, limit in zip(("D1", "D2", "D3"), _GOALS_MM[kind], strict=True):
            said = hausdorff(variant, "M_lim", kind)
            for words, key in (("one-sided", "hausdorff_one_sided_mm"), ("HD", "hausdorff_mm")):
                read = partial(_distance, variant=variant, kind=kind, key=key, lies=lies)
                shown = said.text if said and words == "one-sided" else EMPTY
                goals.append(StudyGoal(f"tumor {words}, {variant}, {kind}", read, limit, shown))
    return [
        *goals,
        StudyGoal("tumor centre, worst variant of any case", _worst_center, 2.5, "< 10"),
        StudyGoal(
            "mIoU, deformed variants", partial(_miou, deformed=True), 0.90, "0.71", high=True
        ),
        StudyGoal("mIoU, all variants", partial(_miou, deformed=False), 0.90, high=True),
        StudyGoal("target error, deformed variants", partial(_targets, deformed=True), 2.0),
        StudyGoal("target error, all variants", partial(_targets, deformed=False), 2.0),
        StudyGoal("target error, worst variant of any case", _worst_target),
        StudyGoal("hidden surface: tumor HD, times", partial(_ratio, of=_tumor_distances), 1.3),
        StudyGoal("hidden surface: target error, times", partial(_ratio, of=_target_errors), 1.3),
        StudyGoal("training, minutes", _training, _training_limit(cells), "120 (RTX 4090)"),
        StudyGoal("scenes with a part not found, %", _failed),
    ]


def _distance(cells: list[dict], variant: str, kind: Kind, key: str, lies: Lies) -> float | None:
    """Of tumors of a kind in a variant: median over cases and tumors."""
    here = pick(_noisy(cells), variant=variant)
    values = [
        value
        for case in names(here, "case")
        for tumor, lie in lies[case].items()
        if lie.kind == kind
        for value in _over_seeds(pick(here, case=case), partial(_of_part, part=tumor, key=key))
    ]
    return _median(values)


def _worst_center(cells: list[dict]) -> float | None:
    return _worst(_of_tumors(_noisy(cells), "center_mm"))


def _miou(cells: list[dict], deformed: bool) -> float | None:
    return _median(_over_seeds(_noisy(cells, deformed), lambda cell: cell["miou"]))


def _targets(cells: list[dict], deformed: bool) -> float | None:
    return _median(_target_errors(_noisy(cells, deformed)))


def _worst_target(cells: list[dict]) -> float | None:
    return _worst(_target_errors(_noisy(cells)))


def _ratio(cells: list[dict], of: Callable[[list[dict]], list[float | None]]) -> float | None:
    hidden = [cell for cell in cells if "=" in cell["spec"]["fault"]]
    above, below = _median(of(hidden)), _median(of(pick(cells, fault="clean")))
    if above is None:
        return None
    return above / below if below else None


def _training(cells: list[dict]) -> float | None:
    spent = [cell["prepare_s"] for cell in cells if cell["spec"]["method"]["kind"] != "bound"]
    return _worst(spent, 60.0)


def _training_limit(cells: list[dict]) -> float | None:
    """The goal on the device that trained, if there is one for it."""
    devices = {cell["method"]["device"] for cell in pick(cells, method=CLINIC)}
    limits = [v for device in devices for key, v in _TRAINING_MIN.items() if key in device]
    return limits[0] if len(limits) == len(devices) == 1 else None


def _failed(cells: list[dict]) -> float | None:
    lost = [cell["failed"] is not None for cell in _noisy(cells)]
    if not lost:
        raise LookupError
    return 100 * sum(lost) / len(lost)


def _noisy(cells: list[dict], deformed: bool = False) -> list[dict]:
    """The scenes without further faults; ``deformed``: neither at rest nor turned only."""
    here = pick(cells, fault="none")
    if not deformed:
        return here
    variants = {cell["spec"]["variant"] for cell in here}
    kept = {name for name in variants if name != _UPRIGHT and not name.startswith(_TURNED)}
    return [cell for cell in here if cell["spec"]["variant"] in kept]


def _of_part(cell: dict, part: str, key: str) -> float | None:
    metrics = cell["parts"][part]
    return metrics.get(key) if metrics["found"] else None


def _of_tumors(cells: list[dict], key: str) -> list[float | None]:
    """One value for each scene and tumor."""
    return [
        value
        for case in names(cells, "case")
        for here in [pick(cells, case=case)]
        for tumor in here[0]["parts"]
        if tumor != "kidney"
        for value in _over_seeds(here, partial(_of_part, part=tumor, key=key))
    ]


def _tumor_distances(cells: list[dict]) -> list[float | None]:
    return _of_tumors(cells, "hausdorff_mm")


def _target_errors(cells: list[dict]) -> list[float | None]:
    return _over_seeds(cells, target_error) if carries(cells) else []


def _over_seeds(cells: list[dict], value: Callable[[dict], float | None]) -> list[float | None]:
    """For each scene the mean over the methods' seeds; None where a seed has none."""
    scenes: dict[tuple, list[float | None]] = {}
    for cell in cells:
        spec = cell["spec"]
        scene = (spec["case"], spec["scene"], spec["fault"], spec["fault_seed"])
        scenes.setdefault(scene, []).append(value(cell))
    return [_mean(values) for values in scenes.values()]


def _mean(values: list[float | None]) -> float | None:
    finite = [value for value in values if value is not None]
    return sum(finite) / len(finite) if len(finite) == len(values) else None


def _median(values: list[float | None]) -> float | None:
    if not values:
        raise LookupError
    return median(values)


def _worst(values: Iterable[float | None], per: float = 1.0) -> float | None:
    values = list(values)
    if not values:
        raise LookupError
    finite = [value for value in values if value is not None]
    return max(finite) / per if len(finite) == len(values) else None


def _limit(goal: StudyGoal) -> str:
    if goal.limit is None:
        return EMPTY
    return f"{'≥' if goal.high else '≤'} {goal.limit:g}"


def _with_verdict(goal: StudyGoal, cells: list[dict]) -> str:
    verdict = goal.verdict(cells)
    value = goal.value(cells, ours=True)
    return value if verdict == _NOTHING else f"{value} ({verdict})"
