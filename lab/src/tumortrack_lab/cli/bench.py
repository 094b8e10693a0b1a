"""`tumortrack bench`: speed; a table, JSON, blocks of a document."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

TRAINED = Path("runs/bench")  # models trained to be measured
_WIDE = 150  # characters of a table that goes to a file


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the speed of every part on this machine, networks beside a naive form, in turns.

    Attributes:
        only: which parts; default: all.
        quick: shorter measurements, about a minute in all once there are models.
        out: JSON file to write.
        document: Markdown file whose marked blocks are to be filled, such as docs/performance.md.
    """

    only: tuple[
        Literal[
            "generator", "elastic-generator", "frame", "tracking", "volume", "command", "planning",
            "gpu", "training", "whole-training",
        ],
        ...,
    ] = ()  # fmt: skip
    quick: bool = False
    out: Path = Path("runs/bench.json")
    document: Path | None = None

    def run(self) -> None:
        """Measure, show, write. Raises InputError: a document without its markers."""
        from tumortrack.cli.console import console, say
        from tumortrack.core.process import available_cores
        from tumortrack_lab.bench.machine import describe_machine
        from tumortrack_lab.bench.report import BLOCKS, line, rich_table, write_bench
        from tumortrack_lab.bench.rows import BenchResult
        from tumortrack_lab.bench.run import GROUPS, measure, tasks_of
        from tumortrack_lab.study.document import ReportWriter

        words = ["tumortrack bench", *(["--only", *self.only] if self.only else [])]
        command = " ".join([*words, *(["--quick"] if self.quick else [])])
        if self.document is not None:
            ReportWriter(self.document, command).check(BLOCKS)
        machine = describe_machine()
        tasks = tasks_of(self.only or tuple(GROUPS), TRAINED, self.quick, available_cores())
        with console.status("starting ...") as status:
            report = status.update if console.is_terminal else say
            rows = measure(tasks, report, lambda row: say(line(row)))
        found = BenchResult(machine=machine, command=command, rows=rows)
        shown = console if console.is_terminal else Console(width=_WIDE)
        shown.print(rich_table(found))
        for path in write_bench(found, self.out, self.document):
            say(f"written to {path}")
