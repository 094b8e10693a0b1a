"""`tumortrack bench`: how fast every part is on this machine; fills a document."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tumortrack.core import store

MODELS = Path("runs/bench")  # where the model to measure is kept


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the speed of every part on this machine.

    Attributes:
        only: which parts; default: all.
        quick: shorter measurements, about a minute in all once there is a model (in runs/bench).
        out: JSON file to write.
        document: Markdown file that shows the tables, such as docs/performance.md; they go to
            data/*.csv beside it.
    """

    only: tuple[Literal["frame", "tracking", "volume", "command", "patient", "planning"], ...] = ()
    quick: bool = False
    out: Path = Path("runs/bench.json")
    document: Path | None = None

    def run(self) -> None:
        """Measure, show, write. Raises InputError: no such document."""
        from tumortrack.cli.console import say
        from tumortrack.core.process import available_cores
        from tumortrack_lab.bench.report import figures, write_bench
        from tumortrack_lab.bench.run import GROUPS, measure, tasks_of
        from tumortrack_lab.study.scripts import check_page

        if self.out.exists() and "machine" not in store.read_json(self.out):
            store.check_place(self.out, "", None)  # no bench wrote it
        words = ["tumortrack bench", *(["--only", *self.only] if self.only else [])]
        command = " ".join([*words, *(["--quick"] if self.quick else [])])
        check_page(self.document)
        groups: tuple[str, ...] = self.only or tuple(GROUPS)
        result = measure(tasks_of(groups, MODELS, self.quick, available_cores()), command)
        print(figures(result).to_string(index=False))
        for path in write_bench(result, self.out, self.document):
            say(f"written to {path}")
