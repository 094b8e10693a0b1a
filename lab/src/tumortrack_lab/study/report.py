"""Measurements -> blocks of a document, and pictures beside it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from tumortrack.core import store
from tumortrack.report.protocol import MEDIANS
from tumortrack_lab.study import goals, plots, resection, tables
from tumortrack_lab.study.document import ReportWriter
from tumortrack_lab.study.measure import Job, spec_of
from tumortrack_lab.study.methods import StudyCase
from tumortrack_lab.study.plan import Section
from tumortrack_lab.study.tables import tidy
from tumortrack_lab.study.tumor_sites import tumor_sites_of

_MEDIANS = (
    f"{MEDIANS.replace('written as null', 'written as not found')} A scene with a part missing "
    "counts as failed; where nothing was found its mIoU is 0 and its target errors are infinite."
)
_OVER_SCENES = f"Distances in mm. {_MEDIANS} ± is the standard deviation over the seeds."
_TARGETS = "mean over the scene's inner targets, for methods that carry points."
_RULES: dict[Section, str] = {
    "accuracy": "Distances in mm: median / 90 % / 95 % / worst of all scenes and seeds (nearest "
    "rank; of mIoU the lowest are the worst). A part that was not found counts as infinitely far. "
    "HD is symmetric; best rigid pose: an oracle, the undeformed organ laid on the true one; true "
    "visible surface, all true surfaces: our elastic body laid on the truth's points, in least "
    "squares, so a single distance may come out below them. No method can use these three. "
    f"Target error: {_TARGETS} Seconds are a network's without the dense volume; busy: other jobs "
    "ran beside (load above 1.5), so they are no more than upper bounds.",
    "goals": goals.RULE,
    "ablation": "Distances in mm. Every model saw the same number of scenes; medians over the "
    "deformed variants and all tumors, ± is the standard deviation over the seeds; in brackets the "
    "change against clinic. A part that was not found counts as infinitely far. The prior of the "
    "refinement is that of the elastic body in every row. Seconds are of a machine with the load "
    "said here.",
    "deformation": "mIoU; ± is the standard deviation over the seeds.",
    "faults": f"{_OVER_SCENES} In brackets: the change against clean depth.",
    "views": f"{_OVER_SCENES} In brackets: the change against the clean view.",
    "severity": f"Distances in mm. {_MEDIANS} Here they are over the states and the random draws "
    f"of the fault. Most kinds have the clean scenes as one level; distance has not. Target error: "
    f"{_TARGETS} Bars in the picture reach to the best and the worst scene, a cross at the top is "
    "a level where some scene's tumor was not found.",
    "resection": resection.RULE,
}


def section_blocks(
    section: Section, measurements: list[dict], cases: tuple[StudyCase, ...], writer: ReportWriter
) -> dict[str, str]:
    """The block of one section, its pictures drawn: name -> Markdown."""
    if section == "goals":
        sites = {case.name: tumor_sites_of(case.anatomy_ct) for case in cases}
        texts = [goals.goal_table(tidy(measurements), sites)]
    elif section == "resection":
        texts = [resection.tables_of(measurements)]
    else:
        frame, texts = tidy(measurements), []
        for case in cases:
            mine = frame[frame.case == case.name]
            if mine.empty:
                continue  # a section may ask for some cases alone
            if len(cases) > 1 or section == "accuracy":
                texts.append(f"#### {case.name}")
            texts += _MAKERS[section](mine, case, writer)
    below = f"{tables.caption(measurements, writer.command)} {_RULES[section]}"
    return {section: "\n\n".join([*texts, below])}


def _accuracy(frame: pd.DataFrame, case: StudyCase, writer: ReportWriter) -> list[str]:
    sites = tumor_sites_of(case.anatomy_ct)
    texts = [tables.sites_text(case.name, sites), tables.accuracy(frame, sites)]
    for key in ("depth", "displacement"):
        image = writer.image(f"results_{key}_{case.name}")
        if plots.error_against(frame[tables.is_deformed(frame)], f"{key}_mm", image):
            texts.append(writer.link(image, f"{case.name}: tumor error against {key}"))
    return texts


def _severity(frame: pd.DataFrame, case: StudyCase, writer: ReportWriter) -> list[str]:
    image = writer.image("results_severity")
    plots.severity_curves(frame, image)
    words = f"{case.name}: tumor error against severity"
    return [writer.link(image, words), tables.severities(frame)]


_MAKERS: dict[Section, Callable[[pd.DataFrame, StudyCase, ReportWriter], list[str]]] = {
    "accuracy": _accuracy,
    "ablation": lambda frame, *_: [tables.ablation(frame)],
    "deformation": lambda frame, *_: [tables.deformation(frame)],
    "faults": lambda frame, *_: [tables.conditions(frame, "fault", "clean")],
    "views": lambda frame, *_: [tables.conditions(frame, "view", "clean")],
    "severity": _severity,
}


def gallery_block(jobs: list[Job], seed: int, writer: ReportWriter, memory: Path) -> dict[str, str]:
    """The gallery of these jobs (one case; methods x scenes; ``seed``: of the networks), drawn
    again only where the methods or scenes have changed since ``memory`` was written."""
    image = writer.image("results_gallery")
    specs = "".join(spec_of(job).digest for job in jobs)
    digest = hashlib.sha256(specs.encode()).hexdigest()
    drawn = store.read_json(memory).get("gallery") if memory.exists() else None
    if drawn != digest or not image.exists():
        plots.gallery(jobs, image)
        store.write_json(memory, {"gallery": digest})
    text = f"`{writer.command}`: {jobs[0].case.name}, seed {seed} of the networks."
    return {"gallery": f"{writer.link(image, 'estimate over truth')}\n\n{text}"}
