"""`tumortrack bench`: speed beside naive forms; a table, JSON, blocks of a document."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from tumortrack.core import store
from tumortrack.core.errors import InputError

TRAINED = Path("runs/bench")  # models trained to be measured
_WIDE = 150  # characters of a table that goes to a file


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the speed of every part on this machine, each beside its naive form, in turns.

    Attributes:
        only: which parts; default: all.
        quick: shorter measurements, about a minute in all once there are models.
        curves: also how time and memory grow with queries, points, tumors, voxels and batch.
        model: folder that `train` wrote, to be measured instead of the one that the bench trains
            (kept in runs/bench).
        cloud: of that model's organ, freed of its background; .ply, .pcd or .npz in mm.
        out: JSON file to write; curves lie beside it.
        document: Markdown file whose marked blocks are to be filled, such as docs/performance.md.
    """

    only: tuple[
        Literal[
            "generator", "elastic-generator", "encoder", "decoder", "frame", "tracking", "volume",
            "command", "patient", "planning", "gpu", "training", "whole-training",
        ],
        ...,
    ] = ()  # fmt: skip
    quick: bool = False
    curves: bool = False
    model: Path | None = None
    cloud: Path | None = None
    out: Path = Path("runs/bench.json")
    document: Path | None = None

    def run(self) -> None:
        """Measure, show, write. Raises InputError: a model without a cloud or the other way, a
        document without its markers."""
        from tumortrack.cli.console import console, say
        from tumortrack.core.process import available_cores
        from tumortrack_lab.bench.report import BLOCKS, line, rich_table, write_bench
        from tumortrack_lab.bench.run import CURVES, GROUPS, Task, measure, tasks_of
        from tumortrack_lab.study.document import ReportWriter

        if (self.model is None) != (self.cloud is None):
            raise InputError(
                "--model and --cloud belong together: a model, and a cloud of its organ."
            )
        for path in (self.out, self.out.with_name(f"{self.out.stem}_curves.json")):
            if path.exists() and "machine" not in store.read_json(path):
                store.check_place(path, "", None)  # no bench wrote it
        words = ["tumortrack bench", *(["--only", *self.only] if self.only else [])]
        words += [f"--{name}" for name in ("quick", "curves") if getattr(self, name)]
        command = " ".join(words)
        if self.document is not None:
            ReportWriter(self.document, command).check(BLOCKS)
        given = (str(self.model), str(self.cloud)) if self.model else None
        common = Task(threads=1, folder=str(TRAINED), given=given, quick=self.quick)
        curves = tuple(CURVES) if self.curves else ()
        tasks = tasks_of(common, self.only or tuple(GROUPS), curves, available_cores())
        with console.status("starting ...") as status:
            report = status.update if console.is_terminal else say
            report("starting ...")
            found = measure(tasks, command, report, lambda row, left: say(line(row, left)))
        shown = console if console.is_terminal else Console(width=_WIDE)
        shown.print(rich_table(found))
        for path in write_bench(found, self.out, self.document):
            say(f"written to {path}")
