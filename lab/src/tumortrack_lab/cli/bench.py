"""`tumortrack bench`: speed beside naive forms; a table, JSON, blocks of a document."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from tumortrack.core.errors import InputError, TumortrackError

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
    from tumortrack_lab.bench.plan import CURVES, Wish, measure
    from tumortrack_lab.bench.report import check_document, write_bench
    from tumortrack_lab.bench.suite import GROUPS
    from tumortrack_lab.bench.tables import line, rich_table

    if (options.model is None) != (options.cloud is None):
        raise InputError("--model and --cloud belong together: a model, and a cloud of its organ.")
    if options.document is not None:
        check_document(options.document)
    wish = Wish(
        groups=options.only or tuple(GROUPS),
        curves=tuple(CURVES) if options.curves else (),
        quick=options.quick,
        folder=TRAINED,
        model=options.model,
        cloud=options.cloud,
    )
    with console.status("starting ...") as status:
        told = status.update if console.is_terminal else say
        found = measure(wish, _WORKER, _command(options), told, lambda row: say(line(row)))
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
    import msgspec

    from tumortrack.core.config import from_builtins
    from tumortrack_lab.bench.tasks import Task, TaskMessage, carry_out, keep_to_cores, subject_of

    task = from_builtins(msgspec.json.decode(task_json), Task, "the bench's task")
    keep_to_cores(task.threads)
    from tumortrack.training.presets import PRESETS
    from tumortrack_lab.bench.subject import ConfigOf

    def limited(name: str) -> ConfigOf:
        return lambda anatomy: PRESETS[name](anatomy, "limited")

    presets = {name: limited(name) for name in PRESETS}

    def tell(said: TaskMessage) -> None:
        print(msgspec.json.encode(said).decode(), flush=True)

    for said in carry_out(task, subject_of(task, presets), tell):
        tell(said)


if __name__ == "__main__":
    try:
        _work(sys.argv[1])
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
