"""How far margins can be trusted, from tables that `tumortrack margins` wrote, an organ each.

    make trust ARGS='MODEL/margins.jsonl ...'     (a minute: nothing but the worst cases is located)

Fills a block of docs/trust.md, and writes its tables and pictures. An unfinished table is
used as far as it goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro

from tumortrack.cli.console import say
from tumortrack_lab.margins.calibration import WIDEST_MM
from tumortrack_lab.study import scripts, trust
from tumortrack_lab.study.document import table_of

BLOCK = "trust"
_WORST = 6  # so many of the worst accepted answers are drawn


@dataclass(frozen=True)
class Options:
    """Tables and plots of what margins are worth."""

    tables: tyro.conf.Positional[tuple[Path, ...]]
    """Files that `tumortrack margins` wrote beside the models."""
    document: Path = Path("docs/trust.md")
    """Its block is replaced; tables and pictures go beside it."""
    widest: float = WIDEST_MM
    """As of `tumortrack margins`."""


def main(options: Options) -> None:
    """Calibrate on the others, test on what is left out, and write it down."""
    writer = scripts.begun("trust", options.document, BLOCK)
    tables = trust.read_tables(options.tables)
    states = trust.states_of([row for table in tables for row in table.rows])
    fifth = np.random.default_rng(0).permutation(len(states)) % 5 + 1
    parts = {"family": states.family, "organ": states.organ, "fifth": pd.Series(fifth).astype(str)}
    left_out = {}
    for what, part in parts.items():
        left_out[what] = trust.left_out(states, part, 0, widest_mm=options.widest)
        say(f"calibrated without each {what}")
    family = left_out["family"]
    hidden = family[family.refused == ""]
    coverage = trust.coverage(
        left_out | {"family, by hidden surface": hidden.assign(part=hidden.hidden)}
    )
    trust.reliability_picture(
        {f"each {what} left out": judged for what, judged in left_out.items()},
        writer.image("trust_reliability"),
    )
    trust.risk_picture(family, writer.image("trust_risk"))
    worst = trust.worst_picture(family, tables, _WORST, writer.image("trust_worst"))
    short = ["part", "answers %", "within 95 %", "95 % margin median mm"]
    writer.block(
        BLOCK,
        table_of(coverage.loc[coverage["left out"] == "family", short]),
        writer.data("trust-coverage", coverage, "Coverage by what was left out"),
        writer.data("trust-ranks", trust.ranks(family), "Misses, and what goes with them"),
        writer.data("trust-worst", worst, "The worst accepted answers"),
    )
    say(f"written to {options.document}")


if __name__ == "__main__":
    scripts.run(main, Options)
