"""`tumortrack bench`: speed beside naive forms; a table, JSON, blocks of a document."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import msgspec
from rich.console import Console

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_lab.bench.rows import BenchRow

TRAINED = Path("runs/bench")  # models trained to be measured
_WIDE = 150  # characters of a table that goes to a file
_WORKER = [sys.executable, "-m", "tumortrack_lab.cli.bench"]


@dataclass(frozen=True)
class BenchOptions:
    only: tuple[str, ...] = ()
    quick: bool = False
    curves: bool = False
    model: Path | None = None
    cloud: Path | None = None
    out: Path = Path("runs/bench.json")
    document: Path | None = None


def bench(options: BenchOptions) -> None:
    """Measure, show, write.

    Raises:
        InputError: a model without a cloud or the other way, a document without its markers.
    """
    from tumortrack.cli.console import console, say
    from tumortrack_lab.bench.report import BLOCKS, write_bench
    from tumortrack_lab.bench.run import CURVES, GROUPS, BenchRequest, measure
    from tumortrack_lab.bench.tables import line, rich_table
    from tumortrack_lab.study.document import ReportWriter

    if (options.model is None) != (options.cloud is None):
        raise InputError("--model and --cloud belong together: a model, and a cloud of its organ.")
    command, given = _command(options), None
    if options.model is not None and options.cloud is not None:
        given = options.model, options.cloud
    if options.document is not None:
        ReportWriter(options.document, command).check(BLOCKS)
    request = BenchRequest(
        groups=options.only or tuple(GROUPS),
        curves=tuple(CURVES) if options.curves else (),
        quick=options.quick,
        folder=TRAINED,
        given=given,
    )

    def show(row: BenchRow, left: str) -> None:
        say(line(row, left))

    with console.status("starting ...") as status:
        report = status.update if console.is_terminal else say
        found = measure(request, _WORKER, command, report, show)
    shown = console if console.is_terminal else Console(width=_WIDE)
    shown.print(rich_table(found))
    for path in write_bench(found, options.out, options.document):
        say(f"written to {path}")


def _command(options: BenchOptions) -> str:
    words = ["tumortrack bench"]
    words += ["--only", *options.only] if options.only else []
    words += [f"--{name}" for name in ("quick", "curves") if getattr(options, name)]
    return " ".join(words)


def _work(task_json: str) -> None:
    """A process of the bench: carries one task out and writes each result as a line of JSON."""
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
