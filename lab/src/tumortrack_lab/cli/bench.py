"""`tumortrack bench`: speed; lines, JSON, blocks of a document."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tumortrack_lab.bench.groups import GROUPS

TRAINED = Path("runs/bench")  # models trained to be measured
_THREADS = 2  # at most


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the speed of every part on two cores of this machine, networks beside a naive form.

    Attributes:
        only: which parts; default: all.
        quick: shorter measurements, about a minute in all once there are models.
        out: JSON file to write.
        document: Markdown file whose marked blocks are to be filled, such as docs/performance.md.
    """

    only: tuple[
        Literal[
            "generator", "elastic-generator", "frame", "tracking", "volume", "command", "planning",
            "gpu", "training", "whole-training",
        ],
        ...,
    ] = ()  # fmt: skip
    quick: bool = False
    out: Path = Path("runs/bench.json")
    document: Path | None = None

    def run(self) -> None:
        """Measure, show, write. Raises InputError: a document without its markers."""
        from tumortrack.core.process import available_cores

        threads = min(available_cores(), _THREADS)
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = f"{threads}"  # settled when PyTorch is loaded
        if hasattr(os, "sched_setaffinity"):  # Linux alone has it
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])

        from tumortrack.cli.console import say
        from tumortrack.training.presets import PRESETS
        from tumortrack_lab.bench.machine import describe_machine
        from tumortrack_lab.bench.report import BLOCKS, line, write_bench
        from tumortrack_lab.bench.rows import BenchResult
        from tumortrack_lab.bench.subject import BenchSubject
        from tumortrack_lab.study.document import ReportWriter

        words = ["tumortrack bench", *(["--only", *self.only] if self.only else [])]
        command = " ".join([*words, *(["--quick"] if self.quick else [])])
        if self.document is not None:
            ReportWriter(self.document, command).check(BLOCKS)
        machine, subject = describe_machine(), BenchSubject(PRESETS, TRAINED)
        groups = [GROUPS[name] for name in self.only or GROUPS]
        for preset in sorted({preset for group in groups for preset in group.needs}):
            if not subject.trained(preset):
                say(f"training a `{preset}` network to measure")
                subject.train(preset)
        rows = []
        for group in groups:
            seconds = group.quick_s if self.quick else group.seconds
            for workload in group.workloads(subject, seconds):
                rows.append(workload.row(threads, seconds))
                say(line(rows[-1]))
        found = BenchResult(machine=machine, command=command, rows=tuple(rows))
        for path in write_bench(found, self.out, self.document):
            say(f"written to {path}")
