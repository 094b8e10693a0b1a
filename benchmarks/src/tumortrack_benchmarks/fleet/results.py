"""A fleet's results: tables of patients and scenes, patients to look at, and a page."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from tumortrack.core import store
from tumortrack.core.store import write_atomically, writing
from tumortrack_benchmarks.fleet.patients import Patient
from tumortrack_benchmarks.fleet.run import Outcome
from tumortrack_benchmarks.fleet.steps import chain, thumbnail

SCENES, PATIENTS, LOOK, PAGE, PICTURES = (
    "scenes.parquet", "patients.parquet", "look.csv", "index.html", "pictures"
)  # fmt: skip
FAR_MM = (3.0, 5.0)  # larger errors of good estimates' tumor centres are counted
_MOST_WITHOUT = 0.5  # share of the scenes without a good answer
_ERRORS = ("middle_mm", "hausdorff_mm", "surface_mm", "outside_mm")
_RIGID = ("rigid_", "rigid_fit_")  # errors of the best rigid pose, and of a rigid fit
_FIRST = ("patient", "state", "step", "reason", "doubts")
_SCENE = (
    *("patient", "tumor", "scene", "family", "view", "verdict", "reason", *_ERRORS),
    *(f"{prefix}{name}" for prefix in _RIGID for name in (*_ERRORS, "target_mm")),
    *("std_mm", "target_mm", "over_3_mm", "over_5_mm"),
)
_COLUMNS = {
    "patient": "patient", "state": "", "kind": "tumor", "position": "at", "ml": "ml",
    "organ_ml": "organ ml", "good": "good", "poor": "poor", "refused": "refused",
    "middle_mm": "centre mm", "rigid_middle_mm": "best rigid mm",
    "rigid_fit_middle_mm": "rigid fit mm", "middle_worst_mm": "worst mm",
    "largest_ratio": "worst over bound", "holds_for": "holds for", "bound_factor": "bounds times",
}  # fmt: skip
_STYLE = (  # beside that of an evaluation's page
    "main { max-width: none; } section { overflow-x: auto; } th, td { text-align: left; "
    "vertical-align: top; } img { width: 300px; }"
)


def write_results(
    out: Path, patients: Sequence[Patient], outcomes: Mapping[str, Outcome], held: Path
) -> None:
    """Write a fleet's tables, page and pictures into ``out``, replacing earlier ones. Patients
    without an outcome are not done yet. Raises StorageError."""
    with writing(out):
        (out / PICTURES).mkdir(parents=True, exist_ok=True)
    rows, scenes, views = [], [], []
    for patient in patients:
        outcome = outcomes.get(patient.name)
        row: dict[str, Any] = {"patient": patient.name, "state": "open"}
        if outcome is not None and outcome.state in ("done", "there"):
            folder = held / outcome.key[:2] / outcome.key
            content = store.read_json(folder / "summary.json")
            mine = [{**row, **line} for line in tumor_lines(content)]
            for line in mine:
                del line["state"]
            row |= {"state": "done", **patient_row(content, mine)}
            scenes += mine
            _copy(folder, patient.name, out / PICTURES)
        elif outcome is not None:
            row |= {"state": outcome.state, "step": outcome.step, "reason": outcome.reason}
            picture = chain(patient)["prepare"].place(held) / "qc.png"
            if picture.is_file():
                with writing(out):
                    thumbnail(picture, out / PICTURES / f"{patient.name}.webp")
        rows.append(row)
        views += [{"patient": patient.name, "reason": why} for why in reasons_to_look(row)]
    for name, lines, columns in ((PATIENTS, rows, _FIRST), (SCENES, scenes, _SCENE)):
        table = pd.DataFrame(lines)
        table = table.reindex(columns=[*dict.fromkeys((*columns, *table.columns))])
        write_atomically(out / name, table.to_parquet(index=False))
    named = pd.DataFrame(views, columns=["patient", "reason"])
    write_atomically(out / LOOK, named.to_csv(index=False, lineterminator="\n").encode())
    write_atomically(out / PAGE, _page(rows, views, out / PICTURES).encode())


def reasons_to_look(row: Mapping[str, Any]) -> list[str]:
    """Why a person should look at a patient."""
    if row["state"] in ("cannot", "failed"):
        return [f"{row['step'] or row['state']}: {row['reason']}"]
    if row["state"] == "open":
        return []
    reasons = list(row["doubts"].split("\n")) if row["doubts"] else []
    without = row["poor"] + row["refused"]
    if row["scenes"] == 0:
        reasons.append("no state could be made")
    elif without > _MOST_WITHOUT:
        reasons.append(f"{without:.0%} of {row['scenes']} scenes without a good answer")
    if row["over_5_mm"]:
        worst = f"the worst {row['middle_worst_mm']:.1f} mm off"
        reasons.append(f"{row['over_5_mm']} answers called good over 5 mm off, {worst}")
    return reasons


def tumor_lines(content: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """A line of each scene and tumor, with the tumor's position; ``over_3_mm``, ``over_5_mm``: a
    good estimate, but its centre is farther off."""
    for row in content["rows"]:
        about = {key: value for key, value in row.items() if key != "tumors"}
        pairs = zip(content["check"]["tumors"], row["tumors"], strict=True)
        for number, (lies, errors) in enumerate(pairs, start=1):
            good, off_mm = row["verdict"] == "good", errors.get("middle_mm", 0.0)
            over = {f"over_{far:g}_mm": good and off_mm > far for far in FAR_MM}
            yield {**about, "tumor": f"tumor_{number}", **lies, **errors, **over}


def patient_row(content: Mapping[str, Any], lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A patient's figures: of the largest tumor; errors are medians over all tumors of the scenes
    that were answered good (of rigid poses: of all scenes); shares are of scenes."""
    check, margin, rows = content["check"], content["margins"], content["rows"]
    largest = max(check["tumors"], key=lambda tumor: tumor["ml"])
    verdicts = [row["verdict"] for row in rows]
    every = pd.DataFrame(lines).reindex(columns=[*_SCENE])
    good = every[every.verdict == "good"]
    row = {
        "doubts": "\n".join(check["doubts"]), "side": check["side"], "input": check["kind"],
        **{name: check[name] for name in ("organ_ml", "slice_mm", "spacing_mm", "half_turn_mm")},
        **largest, "tumors": len(check["tumors"]), **content["model"],
        "scenes": len(rows), "lost": len(content["failures"]),
        "middle_95_mm": good.middle_mm.quantile(0.95), "middle_worst_mm": good.middle_mm.max(),
        "target_mm": good.drop_duplicates("scene").target_mm.median(),
        "margin_states": margin["states"], "margin_answers": margin["answers"],
        "largest_ratio": margin["largest_ratio"], "holds_for": margin["holds_for"],
        "bound_factor": margin["bound_factor"], "margin_reason": margin["reason"],
    }  # fmt: skip
    for name in ("good", "poor", "refused"):
        row[name] = verdicts.count(name) / len(rows) if rows else 0.0
    for name in ("middle_mm", "hausdorff_mm"):
        row[name] = good[name].median()
        row |= {f"{prefix}{name}": every[f"{prefix}{name}"].median() for prefix in _RIGID}
    for far in FAR_MM:
        row[f"over_{far:g}_mm"] = int(good[f"over_{far:g}_mm"].sum())
    return row


def _copy(folder: Path, name: str, out: Path) -> None:
    """NAME.webp of the case, and NAME-worst.webp."""
    for kind, place in {"case": f"{name}.webp", "worst": f"{name}-worst.webp"}.items():
        if (picture := folder / f"{kind}.webp").exists():
            write_atomically(out / place, picture.read_bytes())


def _page(
    rows: Sequence[Mapping[str, Any]], views: Sequence[Mapping[str, str]], pictures: Path
) -> str:
    states = [row["state"] for row in rows]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    lines = []
    for row in rows:
        name = row["patient"]
        line = {words: _cell(row.get(key)) for key, words in _COLUMNS.items()}
        why = [html.escape(entry["reason"]) for entry in views if entry["patient"] == name]
        images = [f"{PICTURES}/{name}{kind}.webp" for kind in ("", "-worst")]
        shown = [
            f'<a href="{image}"><img loading="lazy" src="{image}" alt="{name}"></a>'
            for image in images
            if (pictures.parent / image).exists()
        ]
        lines.append({**line, "look": "<br>".join(why), "pictures": " ".join(shown)})
    table = pd.DataFrame(lines).to_html(index=False, escape=False, border=0)
    report = resources.files("tumortrack.report").joinpath("page.html").read_text("utf-8")
    style = report.split("<style>")[1].split("</style>")[0] + _STYLE
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>tumortrack: a fleet</title><style>{style}</style></head><body>"
        f"<header><h1>{len(rows)} patients: {counts}</h1><p>tumortrack: a fleet</p></header>"
        '<main><section class="notice"><b>For research use only.</b> Not a medical device.'
        f"</section><section><p>look: what a person should see ({LOOK}). Shares are of scenes; "
        "errors are medians over answers called good; pictures: the case, and the answer that is "
        f"farthest off.</p>{table}</section></main></body></html>\n"
    )


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and pd.isna(value)):
        return "–"
    return f"{value:.2f}" if isinstance(value, float) else html.escape(str(value))
