"""A run in Markdown tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from tumortrack_lab.soak.faults import FAULTS
from tumortrack_lab.soak.judge import Answer, Judge
from tumortrack_lab.study.document import table_of


def document(judge: Judge, summary: dict[str, Any], about: str) -> str:
    """The run's figures, and a row per kind of fault."""
    return "\n\n".join([about, _figures(judge, summary), _faults(judge)]) + "\n"


def memory_marks(judge: Judge) -> dict[str, float]:
    """MB after a minute (or at the first look), at the quarters and at the end."""
    times, megabytes = np.array(judge.memory_mb).T
    marks = {"1 min": 60.0}
    marks |= {name: share * times[-1] for name, share in
              (("1/4", 0.25), ("1/2", 0.5), ("3/4", 0.75), ("end", 1.0))}  # fmt: skip
    return {name: float(megabytes[int(np.abs(times - at).argmin())]) for name, at in marks.items()}


def _figures(judge: Judge, summary: dict[str, Any]) -> str:
    counts, latency, error = judge.counts, judge.latency.summary(), judge.error_mm.summary()
    results = sum(counts[quality] for quality in ("good", "poor", "none"))
    memory = ", ".join(f"{mb:.0f} ({name})" for name, mb in memory_marks(judge).items())
    rows = {
        "results": f"{results:,}: {counts['good']:,} good, {counts['poor']:,} poor, "
        f"{counts['none']:,} none",
        "latency, ms, from the stamp": ", ".join(
            f"{key} {latency.get(key)}" for key in ("p50", "p99", "p99.9", "max")
        ),
        "good estimates, stale": f"{counts['stale']}",
        f"good estimates, a part over {judge.wrong_mm:g} mm off": f"{counts['wrong']}",
        "worst part of good estimates, mm off": ", ".join(
            f"{key} {error.get(key)}" for key in ("p50", "p99", "p99.9", "max")
        ),
        "memory, MB": memory,
        "internal errors": f"{len(summary['defects'])}",
    }
    for name, sink in summary["sinks"].items():
        rows[f"sink {name}"] = (
            f"{sink['delivered']:,} delivered, {sink['dropped']:,} missed, {sink['errors']:,} "
            "errors (of the faults)"
        )
    return table_of(pd.DataFrame(rows.items(), columns=["", ""]))


def _faults(judge: Judge) -> str:
    head = ["fault", "times", "named after (median; longest), s", "in these words"]
    head.append("good again after (longest), s")
    each = {kind: [a for a in judge.answers.values() if a.fault.kind == kind] for kind in FAULTS}
    rows = [_row(kind, answers) for kind, answers in each.items()]
    return table_of(pd.DataFrame(rows, columns=head))


def _row(kind: str, answers: list[Answer]) -> list[str]:
    if not answers:
        return [kind, "0", "", "", ""]
    named = [answer.named_s for answer in answers]
    back_s = max(answer.back_s for answer in answers)
    late = f"{np.median(named):.2f}; {max(named):.2f}"
    return [kind, f"{len(answers)}", late, answers[0].words[:90], f"{back_s:.2f}"]
