"""Summary of an evaluation's scenes: medians and worst cases, good and poor estimates apart."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from tumortrack.core.estimate import FAR_MM, NO_CHECK_FAILED
from tumortrack.core.organ import is_tumor
from tumortrack.report.metrics import SurfaceDistances

DISTANCES = (*(field.name for field in fields(SurfaceDistances)), "center_mm")
TARGET_ERRORS = ("mean", "rms", "median", "p95")
VERDICTS = ("good", "poor", "none")


RULE = (
    "Medians over all scenes that have the part. A part that was not found counts as infinitely "
    "far and with IoU 0; a median that is infinite is written as null. A scene counts as failed "
    "where a part was not found, or where the centre of a tumor (without one: of the organ) is "
    f"over {FAR_MM:g} mm off, whether the answer is called good or poor; where nothing was found "
    "its mIoU is 0 and its target errors are infinite."
)
NO_BASELINES = (
    "Rigid registration is left out: it needs the organ at rest, which models of the preset "
    "elastic alone keep; a function that estimates states none."
)
MEANING = {
    "best_rigid_pose": "an oracle: the undeformed organ, moved onto the true one as well as rigid "
    "motion allows",
    "rigid_fit": "the undeformed organ, fitted to the same points by point-to-plane least squares, "
    "started at the best rigid pose",
}
COLUMNS = {
    "center_mm": "centre off, mm",
    "hausdorff_mm": "surface off at most (Hausdorff), mm",
    "hausdorff_95_mm": "95 % of the surface within, mm",
    "hausdorff_one_sided_mm": "one-sided Hausdorff, mm",
    "surface_mm": "surface off in the mean, mm",
    "iou": "overlap (IoU, 0 to 1)",
}
BASELINES = {"best_rigid_pose": "best rigid pose", "rigid_fit": "rigid fit"}
METHODS = {"estimate": "estimate", **BASELINES}
# Of the two that a surgeon asks for; the third is of targets, where a scene has some.
MEASURES = {"center_mm": "centre", "hausdorff_mm": "surface", "target_mm": "targets"}

Entry = dict[str, Any]


class Table(NamedTuple):
    """For the terminal and the page."""

    title: str
    head: list[str]
    rows: list[list[str]]
    caption: str = ""


def summarise(entries: list[Entry]) -> dict[str, Any]:
    """The report's summary; docs/conventions.md lists its fields.

    For each part medians, ``worst`` and ``p95`` over scenes; ``errors``: of ``all``, ``good`` and
    ``poor`` answers, the errors of the estimate and its baselines, pooled over scenes, tumors and
    targets, the worst with its scene and part. A part that was not found is infinitely far: null.
    """
    summary: dict[str, Any] = {}
    for name in dict.fromkeys(part for entry in entries for part in entry["parts"]):
        rows = {entry["name"]: entry["parts"][name] for entry in entries if name in entry["parts"]}
        summary[name] = _of_part(rows)
        shares = [e["registration_mm"].get(name) for e in entries if "registration_mm" in e]
        if shares and None not in shares:
            summary[name]["registration_mm"] = float(np.sqrt(np.mean(np.square(shares))))
    errors = [entry["tre_mm"] for entry in entries if "tre_mm" in entry]
    if any(errors):
        medians = {
            key: _median([(e or {}).get(key, np.inf) for e in errors]) for key in TARGET_ERRORS
        }
        summary["tre_mm"] = {**medians, "scenes": len(errors)}
    summary["miou"] = _median([entry["miou"] for entry in entries])
    summary["miou_mean"] = float(np.mean([entry["miou"] for entry in entries]))
    groups = {v: [e for e in entries if e["quality"] == v] for v in VERDICTS}
    summary |= {verdict: len(group) for verdict, group in groups.items()}
    failed = [entry for entry in entries if entry["failed"] is not None]
    far = [e for e in failed if all(part["found"] for part in e["parts"].values())]
    summary["failed"], summary["far"] = len(failed), len(far)
    summary["far_good"] = sum(entry["quality"] == "good" for entry in far)
    summary["scenes"] = len(entries)
    answers = {"all": groups["good"] + groups["poor"], **groups}
    answers.pop("none")
    summary["errors"] = {name: _pooled(group) for name, group in answers.items() if group}
    return summary


def worst_center(entry: Entry) -> tuple[float, str]:
    """The largest error of a tumor's centre (without tumors: of the organ's), mm, and its part;
    infinite if it was not found."""
    parts = judged_parts(entry["parts"])
    return max((row.get("center_mm", np.inf), name) for name, row in parts.items())


def judged_parts(parts: dict[str, Any]) -> dict[str, Any]:
    """The tumors; without one, the organ."""
    return dict(list(parts.items())[1:]) or parts


def _of_part(rows: dict[str, Any]) -> dict[str, Any]:
    """``rows``: by scene."""
    far = {key: [row.get(key, np.inf) for row in rows.values()] for key in DISTANCES}
    names = list(rows)
    return {
        **{key: _median(values) for key, values in far.items()},
        "iou": _median([row["iou"] for row in rows.values()]),
        "found": sum(row["found"] for row in rows.values()),
        "scenes": len(rows),
        "p95": {key: _p95(values) for key, values in far.items()},
        "worst": {
            key: {"mm": _finite(max(values)), "scene": names[int(np.argmax(values))]}
            for key, values in far.items()
        },
    }


def _pooled(entries: list[Entry]) -> dict[str, Any]:
    """Errors by method, over the scenes with an answer of that method."""
    group: dict[str, Any] = {"scenes": len(entries)}
    for method in METHODS:
        answers = [(entry, _answer(entry, method)) for entry in entries]
        answers = [(entry, answer) for entry, answer in answers if "parts" in answer]
        if not answers:
            continue
        group[method] = {"scenes": len(answers)}
        for key in ("center_mm", "hausdorff_mm"):
            rows = [
                (row.get(key, np.inf), entry["name"], part)
                for entry, answer in answers
                for part, row in answer["parts"].items()
            ]
            group[method][key] = _spread([row[0] for row in rows], max(rows))
        known = [(e["name"], a["tre_mm"], list(e["parts"])) for e, a in answers if a.get("tre_mm")]
        if known:
            values = [mm for _, errors, _ in known for mm in errors["each"]]
            scene, errors, names = max(known, key=lambda row: row[1]["max"])
            label = errors["max_label"]
            part = names[label - 1] if label <= len(names) else f"label {label}"
            group[method]["target_mm"] = _spread(values, (errors["max"], scene, part))
    return group


def _answer(entry: Entry, method: str) -> dict[str, Any]:
    """A method's errors of the judged parts and of targets."""
    if method == "estimate":
        return {**entry, "parts": judged_parts(entry["parts"])}
    return dict(entry.get("baselines", {}).get(method, {}))


def _spread(values: list[float], worst: tuple[float, str, str]) -> dict[str, Any]:
    """Median, 95th percentile and the worst. ``worst``: mm, scene, part."""
    about = {"count": len(values), "median": _median(values), "p95": _p95(values)}
    return {**about, "worst": _finite(worst[0]), "scene": worst[1], "part": worst[2]}


def _median(values: list[float]) -> float | None:
    """The median; None if infinite (at least half the scenes without the part)."""
    ordered = np.sort(np.array(values, float))
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return float((low + high) / 2) if np.isfinite(high) else None


def _p95(values: list[float]) -> float | None:
    """The smallest value that 95 % of them do not exceed."""
    return _finite(float(np.percentile(np.array(values, float), 95, method="inverted_cdf")))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


# --- in words ---


def number(value: float | None, digits: int = 2) -> str:
    """None: the part was not found."""
    return "not found" if value is None else f"{value:.{digits}f}"


def words(part: str) -> str:
    return part.replace("_", " ")


def verdict_counts(summary: dict[str, Any]) -> str:
    n = summary["scenes"]
    scenes = f"{n} scene{'s' * (n != 1)}"
    return f"{scenes}: {summary['good']} good, {summary['poor']} poor, {summary['none']} none"


def spread_words(spread: dict[str, Any]) -> str:
    median, p95, worst = (number(spread[key], 1) for key in ("median", "p95", "worst"))
    where = f"{words(spread['part'])} of {spread['scene']}"
    return f"median {median} mm, 95 % within {p95} mm, worst {worst} mm ({where})"


def headlines(summary: dict[str, Any]) -> list[str]:
    """Errors of good answers, of poor ones and of the baselines, pooled over all scenes, tumors and
    targets."""
    groups = summary["errors"]
    named = {verdict: groups.get(verdict, {}).get("estimate", {}) for verdict in ("good", "poor")}
    named |= {name: groups.get("all", {}).get(baseline, {}) for baseline, name in BASELINES.items()}
    return [f"{name}: {line}" for name, group in named.items() for line in measures(group)]


def measures(group: dict[str, Any]) -> list[str]:
    """A line each for errors of centres and of targets, if the group has them."""
    lines = []
    if "center_mm" in group:
        spread = group["center_mm"]
        part = "tumor" if is_tumor(spread["part"]) else "organ"
        lines.append(f"{part} centre off: {spread_words(spread)}")
    if "target_mm" in group:
        spread = group["target_mm"]
        lines.append(f"error of {spread['count']} targets: {spread_words(spread)}")
    return lines


def triple(spread: dict[str, Any] | None) -> str:
    """Median / 95 % / worst."""
    if spread is None:
        return ""
    return " / ".join(number(spread[key], 1) for key in ("median", "p95", "worst"))


def error_table(summary: dict[str, Any]) -> Table:
    """By verdict and method."""
    rows = [
        [verdict, METHODS[method], *(triple(group[method].get(key)) for key in MEASURES)]
        for verdict, group in summary["errors"].items()
        for method in METHODS
        if method in group
    ]
    known = "best_rigid_pose" in summary["errors"].get("all", {})
    caption = "; ".join(f"{BASELINES[name]}: {text}" for name, text in MEANING.items())
    title = "errors in mm: median / 95 % within / worst, over all scenes and tumors"
    return Table(title, ["answers", "method", *MEASURES.values()], rows, caption if known else "")


def part_table(summary: dict[str, Any]) -> Table:
    """Medians over the scenes."""
    parts = {k: row for k, row in summary.items() if isinstance(row, dict) and "found" in row}
    head = ["part", "found", "HD", "1-sided", "HD95", "surface", "centre", "IoU", "worst HD"]
    registered = any("registration_mm" in part for part in parts.values())
    rows = []
    for name, part in parts.items():
        numbers = [number(part[key], 1 if key != "surface_mm" else 2) for key in DISTANCES]
        share = [number(part.get("registration_mm"))] if registered else []
        found, worst = f"{part['found']}/{part['scenes']}", part["worst"]["hausdorff_mm"]["mm"]
        rows.append([name, found, *numbers, number(part["iou"]), number(worst, 1), *share])
    overlap = f"mIoU {summary['miou']:.3f} (overlap, 1: perfect)"
    title = f"medians over scenes, distances in mm; {overlap}"
    caption = "± mm: the expected error of the truth, by its registration" * registered
    return Table(title, [*head, *["± mm"] * registered], rows, caption)


def scene_table(entries: list[Entry]) -> Table:
    """Each scene, what was done to the organ, the verdict, and how far off the farthest tumor is,
    by the estimate and by the rigid fit; and, if the scenes have targets, their mean error."""
    targets = any("tre_mm" in entry for entry in entries)
    rows, pairs = [], list[bool]()
    for entry in entries:
        far_mm, part = worst_center(entry)
        rigid_mm = baseline_center(entry, "rigid_fit", part)
        row = [
            entry["name"],
            entry.get("message", ""),
            entry["quality"],
            number(_finite(far_mm), 1),
        ]
        row.append("-" if rigid_mm is None else number(rigid_mm, 1))
        errors = entry.get("tre_mm")
        rows.append([*row, *[number(errors["mean"], 1) if errors else "-"] * targets])
        if rigid_mm is not None:
            pairs.append(far_mm < rigid_mm)
    caption = (
        "off: the middle of the tumor that is farthest off, mm; nearer than by the rigid fit in "
        f"{sum(pairs)} of {len(pairs)}"
    )
    head = ["scene", "organ", "verdict", "off", "rigid fit", *["targets"] * targets]
    return Table("", head, rows, caption)


def side_by_side(methods: dict[str, list[Entry]]) -> Table:
    """Several methods' answers to the same scenes: the verdict of each, how far off the farthest
    tumor's middle and surface (Hausdorff) are, and the time."""
    rows = []
    for entries in zip(*methods.values(), strict=True):
        row = [entries[0]["name"]]
        for entry in entries:
            surfaces = (part.get("hausdorff_mm") for part in judged_parts(entry["parts"]).values())
            surface_mm = max(np.inf if mm is None else mm for mm in surfaces)
            figures = worst_center(entry)[0], surface_mm, entry.get("seconds", np.inf)
            shown = (f"{mm:.1f}" if np.isfinite(mm) else "-" for mm in figures)
            row += [entry["quality"], *shown]
        rows.append(row)
    head = [column for name in methods for column in (name, "off", "HD", "s")]
    caption = "off: a tumor's middle, HD: its surface (Hausdorff), at worst, mm; s: seconds"
    return Table("", ["scene", *head], rows, caption)


def baseline_center(entry: Entry, baseline: str, part: str) -> float | None:
    """How far off that rigid registration has the middle of a part, mm; None: it was not done."""
    parts = entry.get("baselines", {}).get(baseline, {}).get("parts", {})
    return parts[part]["center_mm"] if part in parts else None


def conclusions(entries: list[Entry]) -> list[str]:
    """What was good, what was wrong and why: the counts, then a line for each scene without a good
    answer, or with a good one that failed."""
    right = [entry["quality"] for entry in entries if not entry["failed"]]
    wrong = [entry["quality"] for entry in entries if entry["failed"]]
    lines = [
        f"of {len(entries)}: {right.count('good')} good and right (every tumor within {FAR_MM:g} "
        f"mm), {wrong.count('good')} called good and WRONG, {right.count('poor')} poor though "
        f"right, {wrong.count('poor')} poor and wrong, {wrong.count('none')} without an answer"
    ]
    for entry in entries:
        if entry["quality"] == "good" and not entry["failed"]:
            continue
        if entry["quality"] == "good":
            said, why = "called good and WRONG", [entry["failed"], NO_CHECK_FAILED]
        else:
            though = "" if entry["failed"] else f", though within {FAR_MM:g} mm"
            said, why = f"{entry['quality']}{though}", [entry["reason"], entry["failed"]]
        lines.append(f"{entry['name']}: {said}: {'; '.join(dict.fromkeys(filter(None, why)))}")
    return lines


def scene_note(entry: dict[str, Any]) -> str:
    if entry["quality"] == "none":
        return "no estimate, so there is nothing to measure"
    far_mm, part = worst_center(entry)
    far = f"{far_mm:.1f} mm" if np.isfinite(far_mm) else "not found"
    notes = [f"{words(part)} is farthest off: centre {far}"]
    if errors := entry.get("tre_mm"):
        notes.append(target_text(errors))
    notes.append(f"overlap with the truth (mIoU, 1 is perfect) {entry['miou']:.2f}")
    if entry["failed"]:
        notes.append(f"FAILED: {entry['failed']}")
    return "; ".join(notes)


def target_text(errors: dict[str, Any]) -> str:
    return (
        f"target error {errors['mean']:.1f} mm (mean of {errors['count']}, "
        f"largest {errors['max']:.1f} mm)"
    )
