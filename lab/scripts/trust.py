"""How far margins can be trusted, from tables that `tumortrack margins` wrote, an organ each.

    make trust ARGS='MODEL/margins.jsonl ...'     (a minute: nothing but the worst cases is located)

Fills the blocks of docs/trust.md, which has the protocol, and draws its pictures. A table that is
not finished is used as far as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro

from tumortrack.cli.console import say
from tumortrack.report.calibration import WIDEST_MM
from tumortrack_lab.study import scripts, trust
from tumortrack_lab.study.document import ReportWriter

BLOCKS = [f"trust-{name}" for name in ("coverage", "ranks", "reliability", "risk", "worst")]


@dataclass(frozen=True)
class Options:
    """Tables and plots of what margins are worth."""

    tables: tyro.conf.Positional[tuple[Path, ...]]
    """Files that `tumortrack margins` wrote beside the models."""
    document: Path = Path("docs/trust.md")
    """Its blocks are replaced."""
    worst: int = 6
    """So many of the worst accepted answers are drawn."""
    widest: float = WIDEST_MM
    """As of `tumortrack margins`."""
    seed: int = 0
    """Of what each state is used for."""


def main(options: Options) -> None:
    """Calibrate on the others, test on what is left out, and write it down."""
    writer = ReportWriter(options.document, scripts.make_command("trust"))
    writer.check(BLOCKS)
    tables = trust.read_tables(options.tables)
    states = trust.states_of([row for table in tables for row in table.rows])
    fifth = np.random.default_rng(options.seed).permutation(len(states)) % 5 + 1
    parts = {"family": states.family, "organ": states.organ, "fifth": pd.Series(fifth).astype(str)}
    found = {}
    for what, part in parts.items():
        found[what] = trust.left_out(states, part, options.seed, widest_mm=options.widest)
        say(f"calibrated without each {what}")
    family = found["family"]
    coverage = [trust.coverage_table(one, f"{what} left out") for what, one in found.items()]
    tested = family[family.refused == ""]
    hidden = tested.assign(part=tested.hidden)
    coverage.append(trust.coverage_table(hidden, "hidden surface, families left out"))
    picture = writer.image("trust_reliability")
    trust.reliability_picture(
        {f"each {what} left out": one for what, one in found.items()}, picture
    )
    reliability = writer.link(picture, "stated confidence against the share found within")
    picture = writer.image("trust_risk")
    trust.risk_picture(family, picture)
    risk = writer.link(picture, "share of answers too far off against the share answered")
    picture = writer.image("trust_worst")
    worst = trust.worst_picture(family, tables, options.worst, picture)
    worst += "\n\n" + writer.link(picture, "the worst accepted answers over the truth")
    blocks = ["\n\n".join([f"`{writer.command}`", *coverage])]
    blocks += [trust.ranks_table(family), reliability, risk, worst]
    writer.write(dict(zip(BLOCKS, blocks, strict=True)))
    say(f"written to {options.document}")


if __name__ == "__main__":
    scripts.run(main, Options)
