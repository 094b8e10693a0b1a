"""What a run found: tables on a terminal and in a document, goals, JSON, a picture of curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
from matplotlib.ticker import EngFormatter
from rich.table import Table

from tumortrack.core.store import write_atomically
from tumortrack.report.drawing import new_figure, save
from tumortrack_lab.bench import rows
from tumortrack_lab.bench.machine import NO_GPU
from tumortrack_lab.bench.rows import BenchResult, BenchRow, Point
from tumortrack_lab.study.document import ReportWriter, table

BLOCKS = ("goals", "machine", "speed", "floors", "growth")
_EMPTY = "–"
_GIB, _MIB = 2**30, 2**20
_SECONDS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
_COUNTS = {"T": 1e12, "G": 1e9, "M": 1e6, "k": 1e3, "": 1.0}
# Columns, by what ``_cells`` calls them; a terminal's table has other names for some.
_WHOSE, _NAIVE = ("part", "of", "threads"), ("items a second", "naive", "ratio", "labels equal")
_SPEED = (*_WHOSE, "tumortrack", "quartiles", *_NAIVE)
# What each row has to do at least, and what that would take; shares of the machine's matrix
# products in this precision, and of its memory's bandwidth.
_LEAST = (
    "arithmetic", "memory", "in", "share of the rate", "share of the bandwidth", "floor",
    "times the floor",
)  # fmt: skip
_SHOWN = (*_WHOSE, "took", *_NAIVE, "floor")
_SHOWN_AS = {"of": "", "took": "tumortrack", "items a second": "per s"}
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
_LINEAR = "tumors"  # the other axes are logarithmic


def _digits(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _text(value: float, units: dict[str, float] = _SECONDS) -> str:
    """In the largest unit that it reaches, with three digits: 12.3 ms."""
    unit = next((name for name, size in units.items() if value >= size), [*units][-1])
    return f"{_digits(value / units[unit])} {unit}"


def _agreement(share: float) -> str:
    """Of labels; never rounded up to all of them."""
    return "100 %" if share == 1 else f"{int(share * 1e5) / 1e3:.3f} %"


def _cells(bench: BenchResult, row: BenchRow) -> dict[str, str]:
    """All that tables say of a row."""
    took, work, peaks = row.ours.median_s, row.work, bench.peaks_for(row)
    naive_s, share = row.naive.median_s if row.naive else None, row.agreement
    cells = {
        "part": row.name,
        "of": row.what,
        "threads": f"{row.threads}" if row.device == "cpu" else row.device,
        "took": _text(took),
        "tumortrack": f"{_text(took)} a {row.item}",
        "quartiles": f"± {50 * (row.ours.high_s - row.ours.low_s) / took:.0f} %",
        "items a second": _text(row.per_s, _COUNTS).strip(),
        "naive": _EMPTY if naive_s is None else _text(naive_s),
        "ratio": _EMPTY if row.ratio is None else f"{_digits(row.ratio)} x",
        "labels equal": _EMPTY if share is None else _agreement(share),
        "before torch": _text(row.others.get(rows.BEFORE_TORCH, 0.0)),
        "peak": f"{row.others.get(rows.PEAK, 0.0) / _GIB:.2f} GiB",
        **dict.fromkeys(_LEAST, _EMPTY),
    }
    if work is not None:
        cells["arithmetic"], cells["memory"] = (
            f"{_text(work.flops, _COUNTS)}FLOP",
            f"{_text(work.bytes, _COUNTS)}B",
        )
        cells["in"] = work.precision
    if work is not None and peaks is not None:
        least = peaks.least_s(work)
        cells["share of the rate"], cells["share of the bandwidth"] = (
            f"{100 * seconds / took:.1f} %" for seconds in least
        )
        cells["floor"] = _text(max(least))
        cells["times the floor"] = f"{_digits(took / max(least))} x"
    return cells


def line(row: BenchRow, left: str) -> str:
    """One row, as soon as it is measured; ``left``: how long all others will take."""
    cells = _cells(BenchResult(machine={}, command=""), row)
    naive = "; naive {naive}, {ratio}".format_map(cells) if row.naive else ""
    return "  {part} {of}, threads {threads}: {tumortrack}".format_map(cells) + f"{naive}; {left}"


def rich_table(bench: BenchResult) -> Table:
    """For a terminal."""
    title = f"{bench.machine.get('processor', '')}, {bench.machine.get('date', '')}"
    out = Table(*(_SHOWN_AS.get(key, key) for key in _SHOWN), title=title)
    for row in bench.rows:
        cells = _cells(bench, row)
        out.add_row(*(cells[key] for key in _SHOWN))
    return out


def _table(bench: BenchResult, columns: Sequence[str], of: Sequence[BenchRow]) -> str:
    every = (_cells(bench, row) for row in of)
    return table(columns, [[cells[key] for key in columns] for cells in every], left=2)


def _notes(bench: BenchResult) -> str:
    """What the naive forms are and what else is to be known of a row."""
    lines: dict[str, list[str]] = {}
    for row in bench.rows:
        naive = f"naive: {row.naive_is}" if row.naive_is else ""
        if text := "; ".join(filter(None, (naive, row.note))):
            where = "{part} ({of}, {threads})".format_map(_cells(bench, row))
            lines.setdefault(text, []).append(where)
    few = {
        text: ", ".join(where[:3]) + (f" and {len(where) - 3} more" if len(where) > 3 else "")
        for text, where in lines.items()
    }
    return "\n".join(f"- {where}: {text}." for text, where in few.items())


def _machine_table(bench: BenchResult) -> str:
    """The machine in words, and what it reaches."""
    body = [*bench.machine.items()]
    for peaks in bench.peaks:
        rates = ", ".join(f"{name} {rate / 1e9:,.0f} GFLOP/s" for name, rate in peaks.gemm.items())
        text = f"{rates}; memory {peaks.triad / 1e9:.1f} GB/s"
        body.append((f"measured, {peaks.threads} thread{'s' * (peaks.threads > 1)}", text))
    return table(("this machine", ""), body, left=2)


def _memory_table(bench: BenchResult) -> str:
    """Largest of each curve, and the command line."""
    body = [
        (f"{row.name}, {row.what}", "", f"{row.others[rows.PEAK] / _GIB:.2f} GiB")
        for row in bench.rows
        if row.others.get(rows.PEAK)
    ]
    last = {(point.curve, point.what): point for point in bench.points}
    for (curve, what), point in last.items():
        if point.peak_bytes is not None:
            held = f"{point.peak_bytes / _GIB:.2f} GiB"
            body.append((f"{what}: {point.size:,} ({curve})", _text(point.seconds), held))
    return table(("what", "time", "peak memory of the process"), body)


class SpeedGoal(NamedTuple):
    """``paper``: the paper's or the naive figure; ``row``: name, preset and threads of the row that
    decides (threads None: on a GPU); ``words``: of its cells; ``met``: whether it is enough (None:
    a system that does not count)."""

    figure: str
    paper: str
    goal: str
    row: tuple[str, str, int | None]
    words: str
    met: Callable[[BenchRow], bool | None]

    def verdict(self, bench: BenchResult) -> tuple[str, bool | None]:
        """What was measured, in words, and whether it is enough (None: open)."""
        gpu = bench.machine.get("GPU", NO_GPU)
        for row in bench.rows:
            threads = row.threads if row.device == "cpu" else None
            if (row.name, row.what, threads) == self.row:
                met = self.met(row)
                cells = {**_cells(bench, row), "each": f"{row.per_s:,.0f}/s"}
                text = "not measured" if met is None else self.words.format_map(cells)
                return text if threads else f"{text} on {gpu}", met
        none_at_hand = self.row[2] is None and gpu == NO_GPU
        return "no GPU was at hand" if none_at_hand else "not measured in this run", None


def goals_table(bench: BenchResult) -> str:
    """Figure, the paper's or the naive value, the goal, measured, met."""
    met_text = {True: "yes", False: "no", None: ""}
    body = []
    for goal in GOALS:
        measured, met = goal.verdict(bench)
        body.append((goal.figure, goal.paper, goal.goal, measured, met_text[met]))
    return table(("figure", "paper / naive", "goal", "measured here", "met"), body, left=4)


def _within(limit_s: float, faster: float = 0.0) -> Callable[[BenchRow], bool]:
    return lambda row: row.ours.median_s <= limit_s and (row.ratio or 0.0) >= faster


def _started(row: BenchRow) -> bool:
    return row.ours.median_s < 3 and row.others[rows.BEFORE_TORCH] < 1


def _held(row: BenchRow) -> bool | None:
    peak = row.others[rows.PEAK]
    return peak < 4e9 if peak else None


GOALS = [
    SpeedGoal(*goal)
    for goal in (
        ("frame (1,000 points, 40,000 queries), `paper`, 2 CPU cores", "naive fp32, same run",
         "at least 25 x faster, at least 99.8 % of labels equal", (rows.FRAME, "paper", 2),
         "{ratio} ({took}, naive {naive}), {labels equal} equal",
         lambda row: row.ratio >= 25.0 and row.agreement >= 0.998),
        ("frame, `clinic` (the default), 2 CPU cores", "14 ms on an RTX 4090",
         "at most 14 ms (with AMX)", (rows.FRAME, "clinic", 2), "{took}", _within(0.014)),
        ("tracking frame, `clinic`, 2 CPU cores", "", "at most 5 ms",
         (rows.TRACKING, "clinic", 2), "{took}", _within(0.005)),
        ("frame, `paper`, H100", "(14 ms on an RTX 4090)", "at most 1 ms",
         (rows.FRAME, "paper", None), "{took}", _within(0.001)),
        ("400^3 labels, exact, `paper`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 1.4 s", (rows.VOLUME, "paper", 2), "{took}, {ratio}",
         _within(1.4, faster=50.0)),
        ("400^3 labels, exact, `clinic`, 2 CPU cores", "dense, same run",
         "at least 50 x faster, at most 0.3 s", (rows.VOLUME, "clinic", 2), "{took}, {ratio}",
         _within(0.3, faster=50.0)),
        ("400^3 labels, exact, `paper`, H100", "dense, same run", "at most 10 ms",
         (rows.VOLUME, "paper", None), "{took}", _within(0.01)),
        ("training, `paper`, H100", "861 samples/s on an RTX 4090 (2 h)",
         "at least 10,000 samples/s", (rows.TRAINING, "paper", None), "{each}",
         lambda row: row.per_s >= 10_000.0),
        ("training, `quick`, 2 CPU cores, generator included", "", "at least 300 samples/s",
         (rows.TRAINING, "quick", 2), "{each}", lambda row: row.per_s >= 300.0),
        *((f"generator, {what}, one core, 424 x 240 depth and 2,000 labels",
           "Open3D + NumPy: 15/s", "at least 250/s", (rows.GENERATOR, what, 1), "{each}",
           lambda row: row.per_s >= 250.0) for what in ("drags", "elastic")),
        ("start of `tumortrack locate` to answer, warm disk, `clinic`", "",
         "under 3 s, under 1 s of it before torch", (rows.COMMAND, "clinic", 2),
         "{took}, {before torch} of it before torch", _started),
        ("a label map to the first estimate, `clinic`, 2 CPU cores", "", "at most 15 s",
         (rows.PATIENT, "clinic", 2), "{took}", _within(15.0)),
        *((f"memory of `tumortrack locate --grid 400`, `{preset}`", "",
           "under 4 GB, everything included", (rows.LARGE, preset, 2), "{peak}", _held)
          for preset in ("clinic", "quick")),
    )
]  # fmt: skip


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
    writer, written, blocks = ReportWriter(document, bench.command), [document], {}
    caption = f"`{bench.command}`, {bench.machine.get('date', '')}."
    if bench.rows:
        speed = _table(bench, _SPEED, bench.rows)
        blocks = {
            "goals": f"{goals_table(bench)}\n\n{caption}",
            "machine": _machine_table(bench),
            "speed": f"{speed}\n\n{_notes(bench)}\n\n{caption}",
            "floors": _table(bench, (*_WHOSE, *_LEAST), [row for row in bench.rows if row.work]),
        }
    if bench.points:
        picture = writer.image("growth")
        draw_growth(bench.points, picture)
        link = writer.link(picture, "time and memory as the work grows")
        blocks["growth"] = f"{link}\n\n{_memory_table(bench)}\n\n{caption}"
        written.append(picture)
    writer.write(blocks)
    return written


def draw_growth(points: Sequence[Point], path: Path) -> None:
    """The curves as one picture: time above, memory below, a column for each kind of work."""
    curves = [curve for curve in _ALONG if any(point.curve == curve for point in points)]
    drawing, width = new_figure(3.6 * len(curves), 6.4), 1 / len(curves)
    short = EngFormatter(sep="")
    for column, curve in enumerate(curves):
        mine = [point for point in points if point.curve == curve]
        left, sizes = (column + 0.2) * width, sorted({point.size for point in mine})
        above = drawing.add_axes((left, 0.55, 0.76 * width, 0.4))
        below = drawing.add_axes((left, 0.09, 0.76 * width, 0.36))
        for axes in (above, below):
            for name in dict.fromkeys(point.what for point in mine):
                color, marker = _STYLES[name.replace(",", " ").split()[0]]
                chosen = [
                    (p.size, p.seconds if axes is above else (p.peak_bytes or 0) / _MIB)
                    for p in mine
                    if p.what == name
                ]
                x, y = zip(*chosen, strict=True)
                axes.plot(x, y, color=color, marker=marker, label=name, linewidth=1.5)
            if curve != _LINEAR:
                axes.set_xscale("log")
            axes.set_xticks(sizes, [short(size) for size in sizes])
            axes.minorticks_off()
            axes.grid(alpha=0.25)
            axes.tick_params(labelsize=9)
        above.set_yscale("log")
        below.set_ylim(0, 1.05 * below.get_ylim()[1])
        below.set_xlabel(_ALONG[curve])
        above.legend(fontsize=9, frameon=False)
        if column == 0:
            above.set_ylabel("seconds, one core")
            below.set_ylabel("peak memory of the process, MiB")
    save(drawing, path)
