"""`tumortrack bench`: speed beside naive forms; a table, JSON, blocks of a document."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from tumortrack.core.errors import InputError, TumortrackError

TRAINED = Path("runs/bench")  # models trained to be measured
_WIDE = 150  # characters of a table that goes to a file
_WORKER = [sys.executable, "-m", "tumortrack_lab.cli.bench"]


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
            "command", "planning", "gpu", "training", "whole-training",
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
        from tumortrack_lab.bench.report import BLOCKS, write_bench
        from tumortrack_lab.bench.run import CURVES, GROUPS, Task, measure, tasks_of
        from tumortrack_lab.bench.tables import line, rich_table
        from tumortrack_lab.study.document import ReportWriter

        if (self.model is None) != (self.cloud is None):
            raise InputError(
                "--model and --cloud belong together: a model, and a cloud of its organ."
            )
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
            found = measure(tasks, _WORKER, command, report, lambda row, left: say(line(row, left)))
        shown = console if console.is_terminal else Console(width=_WIDE)
        shown.print(rich_table(found))
        for path in write_bench(found, self.out, self.document):
            say(f"written to {path}")


def _work(task_json: str) -> None:
    """A process of the bench: carries one task out and writes each result as a line of JSON."""
    import msgspec

    from tumortrack.core.config import from_builtins
    from tumortrack_lab.bench.run import Task, TaskMessage, carry_out

    task = from_builtins(msgspec.json.decode(task_json), Task, "the bench's task")
    if hasattr(os, "sched_setaffinity"):  # Linux alone has it; before libraries start threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: task.threads])
    from tumortrack.training.presets import PRESETS
    from tumortrack_lab.bench.subject import BenchSubject

    def tell(message: TaskMessage) -> None:
        print(msgspec.json.encode(message).decode(), flush=True)

    given = task.given and (Path(task.given[0]), Path(task.given[1]))
    for message in carry_out(task, BenchSubject(PRESETS, Path(task.folder), given), tell):
        tell(message)


if __name__ == "__main__":
    try:
        _work(sys.argv[1])
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
