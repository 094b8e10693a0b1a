"""The experiment of docs/bench.md, rehearsed on a simulated bench.

    make rehearsal ARGS='CASE MODEL OUT'      (five minutes; goes on where it was stopped)

The commands are those of a laboratory; OUT keeps every file. --document writes tables
beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import tyro

from tumortrack.cli.console import say
from tumortrack_lab.rehearsal import tables
from tumortrack_lab.rehearsal.mishaps import Mishaps
from tumortrack_lab.rehearsal.run import Rehearsal
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import ReportWriter, table_of


@dataclass(frozen=True)
class Options:
    """Rehearse the experiment with a case and its model."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    model: tyro.conf.Positional[Path]
    """Its model, or the case again."""
    out: tyro.conf.Positional[Path]
    """Everything goes here."""
    mishaps: bool = True
    """Also act out mishaps."""
    document: Path | None = None
    """A page beside which the tables go."""


def main(options: Options) -> None:
    """Rehearse, and say what was found."""
    words = f"{options.case.name} MODEL OUT --document docs/bench.md"
    writer = ReportWriter(options.document, f"make rehearsal ARGS='{words}'")
    rehearsal = Rehearsal(options.case, options.model, options.out)
    rows, reports = rehearsal.run()
    frames = {"errors": pd.DataFrame(rows), "states": tables.evaluation_rows(reports)}
    if options.mishaps:
        frames["mishaps"] = pd.DataFrame(Mishaps(rehearsal).run())
    for name, frame in frames.items():
        frames[name] = frame.round(2).replace("^tumortrack: ", "", regex=True)
        say(table_of(frames[name]))
    if options.document is not None:
        image = writer.image("bench_rehearsal")
        tables.picture(rehearsal, image)
        writer.tables({f"rehearsal-{name}": frame for name, frame in frames.items()})


if __name__ == "__main__":
    scripts.run(main, Options)
