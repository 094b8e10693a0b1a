"""What a run found, as files: JSON, a picture of the curves, blocks of a document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from tumortrack.core.store import write_atomically
from tumortrack.report.drawing import new_figure, save
from tumortrack_lab.bench import tables
from tumortrack_lab.bench.rows import BenchResult, Point
from tumortrack_lab.study.document import ReportWriter

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLOCKS = ("goals", "machine", "speed", "floors", "growth")
# Okabe and Ito's colours; each curve has a marker of its own too.
_STYLES = {
    "clinic": ("#D55E00", "*"),
    "quick": ("#0072B2", "o"),
    "paper": ("#009E73", "s"),
    "training": ("#000000", "v"),
}
_ALONG = {
    "queries": "queries",
    "points": "points of the cloud",
    "tumors": "tumors",
    "grid": "voxels along the longest side",
    "batch": "samples in a training step",
}
_MIB = 2**20
_LINEAR = "tumors"  # the other axes are logarithmic


def write_bench(bench: BenchResult, out: Path, document: Path | None) -> list[Path]:
    """Write OUT, and where there is a document its blocks and its picture; returns what was
    written. The curves lie beside OUT. Raises InputError: no such document, or a marker of its
    blocks is missing; StorageError: the disk refused."""
    files: dict[Path, object] = {}
    if bench.rows:
        files[out] = msgspec.structs.replace(bench, points=())
    if bench.points:
        curves = {"machine": bench.machine, "points": bench.points}
        files[out.with_name(out.stem + "_curves.json")] = curves
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, msgspec.json.format(msgspec.json.encode(content), indent=1))
    return [*files, *(_document(bench, document) if document else ())]


def _document(bench: BenchResult, document: Path) -> list[Path]:
    writer, written = ReportWriter(document, bench.command), [document]
    caption = f"`{bench.command}`, {bench.machine.get('date', '')}."
    blocks = {}
    if bench.rows:
        blocks = {
            "goals": f"{tables.goals_table(bench)}\n\n{caption}",
            "machine": tables.machine_table(bench),
            "speed": f"{tables.speed_table(bench)}\n\n{tables.notes(bench)}\n\n{caption}",
            "floors": tables.floor_table(bench),
        }
    if bench.points:
        picture = writer.image("growth")
        draw_growth(bench.points, picture)
        link = writer.link(picture, "time and memory as the work grows")
        blocks["growth"] = f"{link}\n\n{tables.memory_table(bench)}\n\n{caption}"
        written.append(picture)
    writer.write(blocks)
    return written


def draw_growth(points: Sequence[Point], path: Path) -> None:
    """The curves as one picture: time above, memory below, a column for each kind of work."""
    curves = [curve for curve in _ALONG if any(point.curve == curve for point in points)]
    drawing = new_figure(3.6 * len(curves), 6.4)
    width = 1 / len(curves)
    for column, curve in enumerate(curves):
        mine = [point for point in points if point.curve == curve]
        left = (column + 0.2) * width
        above = drawing.add_axes((left, 0.55, 0.76 * width, 0.4))
        below = drawing.add_axes((left, 0.09, 0.76 * width, 0.36))
        _lines(above, mine, [point.seconds for point in mine])
        _lines(below, mine, [(point.peak_bytes or 0) / _MIB for point in mine])
        above.set_yscale("log")
        below.set_ylim(bottom=0)
        below.set_xlabel(_ALONG[curve])
        above.legend(fontsize=7, frameon=False)
        if column == 0:
            above.set_ylabel("seconds, one core")
            below.set_ylabel("peak memory of the process, MiB")
    save(drawing, path)


def _lines(axes: Axes, points: Sequence[Point], values: list[float]) -> None:
    for name in dict.fromkeys(point.what for point in points):
        color, marker = _STYLES[name.replace(",", " ").split()[0]]
        chosen = [(p.size, v) for p, v in zip(points, values, strict=True) if p.what == name]
        axes.plot(*zip(*chosen, strict=True), color=color, marker=marker, label=name, linewidth=1.5)
    if points[0].curve != _LINEAR:
        axes.set_xscale("log")
    sizes = sorted({point.size for point in points})
    axes.set_xticks(sizes, [_short(size) for size in sizes])
    axes.minorticks_off()
    axes.grid(alpha=0.25)
    axes.tick_params(labelsize=8)


def _short(size: int) -> str:
    unit, name = next((u for u in ((10**6, "M"), (10**3, "k")) if size >= u[0]), (1, ""))
    return f"{size / unit:g}{name}"
