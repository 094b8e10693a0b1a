"""What a run found, as files: JSON, a picture of the curves, blocks of a document."""

from __future__ import annotations

from pathlib import Path

import msgspec

from tumortrack.core.errors import InputError
from tumortrack.core.store import write_atomically
from tumortrack_lab.bench import tables
from tumortrack_lab.bench.goals import goals_table
from tumortrack_lab.bench.row import BenchResult
from tumortrack_lab.study.book import ReportWriter
from tumortrack_lab.study.markdown import fill

BLOCKS = ("goals", "machine", "speed", "floors", "growth")
_PICTURE = "growth.png"
_CURVES = "_curves.json"


def write_bench(bench: BenchResult, out: Path, document: Path | None) -> list[Path]:
    """Write OUT, and where there is a document its blocks and its picture; returns what was
    written. The curves lie beside OUT.

    Raises:
        InputError: no such document, or a marker of its blocks is missing.
        StorageError: the disk refused.
    """
    written = []
    if bench.rows:
        rows = msgspec.structs.replace(bench, points=())
        written.append(_json(out, msgspec.to_builtins(rows)))
    if bench.points:
        curves = {"machine": bench.machine, "points": msgspec.to_builtins(bench.points)}
        written.append(_json(out.with_name(out.stem + _CURVES), curves))
    if document is not None:
        written += _document(bench, document)
    return written


def check_document(document: Path) -> None:
    """Before anything is measured: the document can be filled.

    Raises:
        InputError: it is not there, or a marker is missing.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{document} cannot be read: {error.strerror}.") from error
    fill(text, dict.fromkeys(BLOCKS, ""))


def _json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, msgspec.json.format(msgspec.json.encode(content), indent=1))
    return path


def _document(bench: BenchResult, document: Path) -> list[Path]:
    book = ReportWriter(document, bench.command)
    caption = f"`{bench.command}`, {bench.machine.get('date', '')}."
    blocks = {}
    if bench.rows:
        blocks = {
            "goals": f"{goals_table(bench)}\n\n{caption}",
            "machine": tables.machine_table(bench),
            "speed": f"{tables.speed_table(bench)}\n\n{tables.notes(bench)}\n\n{caption}",
            "floors": tables.floor_table(bench),
        }
    written = []
    if bench.points:
        from tumortrack_lab.bench.growth import draw_growth

        picture = book.images / _PICTURE
        picture.parent.mkdir(parents=True, exist_ok=True)
        draw_growth(bench.points, picture)
        link = f"![time and memory as the work grows]({book.images.name}/{_PICTURE})"
        blocks["growth"] = f"{link}\n\n{tables.memory_table(bench)}\n\n{caption}"
        written.append(picture)
    book.write(blocks)
    return [document, *written]
