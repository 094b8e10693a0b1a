"""`tumortrack bench`: speed beside naive forms; a table, JSON, blocks of a document."""

from __future__ import annotations

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
        """Measure, show, write.

        Raises:
            InputError: a model without a cloud or the other way, a document without its markers.
        """
        from tumortrack.cli.console import console, say
        from tumortrack_lab.bench.report import BLOCKS, write_bench
        from tumortrack_lab.bench.run import CURVES, GROUPS, BenchRequest, measure
        from tumortrack_lab.bench.tables import line, rich_table
        from tumortrack_lab.study.document import ReportWriter

        if (self.model is None) != (self.cloud is None):
            raise InputError(
                "--model and --cloud belong together: a model, and a cloud of its organ."
            )
        command, given = self._command(), None
        if self.model is not None and self.cloud is not None:
            given = self.model, self.cloud
        if self.document is not None:
            ReportWriter(self.document, command).check(BLOCKS)
        request = BenchRequest(
            groups=self.only or tuple(GROUPS),
            curves=tuple(CURVES) if self.curves else (),
            quick=self.quick,
            folder=TRAINED,
            given=given,
        )
        with console.status("starting ...") as status:
            report = status.update if console.is_terminal else say
            found = measure(
                request, _WORKER, command, report, lambda row, left: say(line(row, left))
            )
        shown = console if console.is_terminal else Console(width=_WIDE)
        shown.print(rich_table(found))
        for path in write_bench(found, self.out, self.document):
            say(f"written to {path}")

    def _command(self) -> str:
        words = ["tumortrack bench"]
        words += ["--only", *self.only] if self.only else []
        words += [f"--{name}" for name in ("quick", "curves") if getattr(self, name)]
        return " ".join(words)


def _work(task_json: str) -> None:
    """A process of the bench: carries one task out and writes each result as a line of JSON."""
    import msgspec

    from tumortrack.core.config import from_builtins
    from tumortrack_lab.bench.run import Task, TaskMessage, carry_out, keep_to_cores

    task = from_builtins(msgspec.json.decode(task_json), Task, "the bench's task")
    keep_to_cores(task.threads)
    from tumortrack.training.presets import PRESETS
    from tumortrack_lab.bench.subject import BenchSubject, ConfigOf

    def limited(name: str) -> ConfigOf:
        return lambda anatomy: PRESETS[name](anatomy, "limited")

    def tell(message: TaskMessage) -> None:
        print(msgspec.json.encode(message).decode(), flush=True)

    given = task.given and (Path(task.given[0]), Path(task.given[1]))
    subject = BenchSubject({name: limited(name) for name in PRESETS}, Path(task.folder), given)
    for message in carry_out(task, subject, tell):
        tell(message)


if __name__ == "__main__":
    try:
        _work(sys.argv[1])
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
