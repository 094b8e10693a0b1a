"""Measured cells -> blocks of a document and pictures beside it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tumortrack.core import store
from tumortrack.core.errors import InputError, StorageError
from tumortrack.report.protocol import RULE
from tumortrack_lab.study import ablation, goals, plots, resection_table, severity, tables
from tumortrack_lab.study.caption import caption
from tumortrack_lab.study.figures import pick
from tumortrack_lab.study.gallery import gallery
from tumortrack_lab.study.markdown import fill
from tumortrack_lab.study.measure import Hashes, Job, StudyCase, spec_of
from tumortrack_lab.study.paper import tumor_lies
from tumortrack_lab.study.plan import Section, StudyPlan

IMAGES = "images"
TURNED = "Rot"  # how the names of turned variants begin


@dataclass(frozen=True)
class ReportWriter:
    """A document with markers, the folder it lies in, and the command that its blocks name."""

    document: Path
    command: str

    @property
    def images(self) -> Path:
        return self.document.parent / IMAGES

    def write(self, blocks: dict[str, str]) -> None:
        """Replace these blocks, in one step.

        Raises:
            InputError: no document, or a marker missing.
            StorageError: the disk refused.
        """
        try:
            before = self.document.read_text(encoding="utf-8")
        except OSError as error:
            raise InputError(f"{self.document} cannot be read: {error.strerror}.") from error
        store.write_atomically(self.document, fill(before, blocks).encode())

    def image(self, name: str) -> Path:
        """Where a picture goes; its folder is made.

        Raises:
            StorageError: the disk refused.
        """
        try:
            self.images.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"cannot write {self.images}: {error.strerror}.") from error
        return self.images / f"results_{name}.png"


def section_blocks(
    section: Section, cells: list[dict], cases: tuple[StudyCase, ...], book: ReportWriter
) -> dict[str, str]:
    """The block of one section, its pictures drawn: name -> markdown."""
    makers: dict[Section, Callable[[list[dict], StudyCase, ReportWriter], str]] = {
        "accuracy": _accuracy,
        "ablation": _ablation,
        "deformation": _deformation,
        "peers": _peers,
        "faults": _faults,
        "views": _views,
        "severity": _severity,
    }
    if section == "goals":
        lies = {case.name: tumor_lies(case.anatomy_ct) for case in cases}
        return {section: f"{goals.tables_of(cells, lies)}\n\n{_below(section, cells, book)}"}
    if section == "resection":
        return {section: f"{resection_table.tables_of(cells)}\n\n{_below(section, cells, book)}"}
    texts = []
    for case in cases:
        mine = pick(cells, case=case.name)
        if not mine:
            continue  # a section may ask for some cases alone
        if len(cases) > 1 or section == "accuracy":
            texts.append(f"#### {case.name}")
        texts.append(makers[section](mine, case, book))
    texts.append(_below(section, cells, book))
    return {section: "\n\n".join(texts)}


def _below(section: Section, cells: list[dict], book: ReportWriter) -> str:
    return f"{caption(cells, book.command)} {_RULES[section]}"


_MEDIANS = RULE.replace("written as null", "written as not found")
_OVER_SCENES = f"Distances in mm. {_MEDIANS} ± is the standard deviation over the seeds."
_RULES: dict[Section, str] = {
    "accuracy": "Distances in mm; ± is the standard deviation over the seeds, one scene each; "
    "target error: mean over the scene's inner targets, for methods that carry points.",
    "goals": goals.RULE,
    "ablation": ablation.RULE,
    "deformation": "mIoU; ± is the standard deviation over the seeds.",
    "peers": f"{_OVER_SCENES} A network's seconds a frame are those of 50,000 queries without the "
    "dense volume, its preparation is training; target error: mean over the scene's inner targets, "
    "for methods that carry points.",
    "faults": f"{_OVER_SCENES} In brackets: the change against clean depth.",
    "views": f"{_OVER_SCENES} In brackets: the change against the clean view.",
    "severity": f"Distances in mm. {_MEDIANS} Here {severity.RULE}",
    "resection": resection_table.RULE,
}


def _accuracy(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    lies = tumor_lies(case.anatomy_ct)
    image = book.image(f"variants_{case.name}")
    plots.error_per_variant(cells, lies, image)
    return "\n\n".join(
        [
            tables.lies_text(case.name, lies),
            _picture(book, image, f"{case.name}: tumor error per variant"),
            tables.accuracy(cells, lies, case.is_paper),
        ]
    )


def _ablation(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    return ablation.table_of(cells)


def _deformation(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    return tables.deformation(cells)


def _peers(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    lies = tumor_lies(case.anatomy_ct)
    turned = [cell for cell in cells if cell["spec"]["variant"].startswith(TURNED)]
    upright = [cell for cell in cells if not cell["spec"]["variant"].startswith(TURNED)]
    texts = []
    for what, group in (("Deformed", upright), ("Turned", turned)):
        if group:
            variants = ", ".join(tables.names(group, "variant"))
            texts += [f"{what} ({variants}):", tables.methods(group, lies)]
    for key in ("depth_mm", "displacement_mm"):
        image = book.image(f"{key.removesuffix('_mm')}_{case.name}")
        if plots.error_against(upright, key, image):
            texts.append(_picture(book, image, f"{case.name}: tumor error against {key[:-3]}"))
    return "\n\n".join(texts)


def _faults(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    return tables.conditions(cells, "fault", "clean")


def _views(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    return tables.conditions(cells, "view", "clean")


def _severity(cells: list[dict], case: StudyCase, book: ReportWriter) -> str:
    image = book.image("severity")
    severity.curves(cells, image)
    picture = _picture(book, image, f"{case.name}: tumor error against severity")
    return f"{picture}\n\n{severity.table_of(cells)}"


def gallery_block(
    plan: StudyPlan, jobs: list[Job], book: ReportWriter, memory: Path
) -> dict[str, str]:
    """The gallery of these jobs (one case; methods x scenes), drawn again only where the methods
    or scenes have changed since ``memory`` was written."""
    image = book.image("gallery")
    specs = "".join(spec_of(job, Hashes()).digest for job in jobs)
    digest = hashlib.sha256(specs.encode()).hexdigest()
    drawn = store.read_json(memory).get("gallery") if memory.exists() else None
    if drawn != digest or not image.exists():
        methods = list({id(job.method): job.method for job in jobs}.values())
        scenes = list(dict.fromkeys((job.variant, job.view) for job in jobs))
        gallery(jobs[0].case, methods, scenes, plan.coarse_grid, image)
        store.write_json(memory, {"gallery": digest})
    text = f"`{book.command}`: {jobs[0].case.name}, seed {plan.seeds[0]} of the networks."
    return {"gallery": f"{_picture(book, image, 'estimate over truth')}\n\n{text}"}


def _picture(book: ReportWriter, image: Path, words: str) -> str:
    return f"![{words}]({image.relative_to(book.document.parent)})"
