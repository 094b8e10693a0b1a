"""`tumortrack bench`: how fast every part is on this machine; fills a document."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
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
        document: Markdown file that shows the tables, such as docs/results.md; they go to
            data/*.csv beside it.
    """

    only: tuple[Literal["frame", "tracking", "volume", "command", "patient", "planning"], ...] = ()
    quick: bool = False
    out: Path = Path("runs/bench.json")
    document: Path | None = None

    def run(self) -> None:
        """Measure, show, write. Raises InputError: no such document."""
        from tumortrack.cli.console import say
        from tumortrack_benchmarks.bench import GROUPS, describe_machine, measure, tables_of
        from tumortrack_benchmarks.scripting import begun

        if self.out.exists() and "machine" not in store.read_json(self.out):
            store.check_place(self.out, "", None)  # no bench wrote it
        words = ["tumortrack bench", *(["--only", *self.only] if self.only else [])]
        command = " ".join([*words, *(["--quick"] if self.quick else [])])
        writer = replace(begun("bench", self.document), command=command)
        machine = describe_machine()
        rows = measure(self.only or tuple(GROUPS), MODELS, self.quick)
        tables = tables_of(rows, machine)
        print(tables["speed-rows"].to_string(index=False))
        self.out.parent.mkdir(parents=True, exist_ok=True)
        found = {"machine": machine, "command": command, "rows": [asdict(row) for row in rows]}
        store.write_json(self.out, found)
        say(f"written to {self.out}")
        writer.tables(tables, sample="medians of calls")
