"""Rows of the command line: `tumortrack locate` as its own process, files on a warm disk."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tumortrack.core.errors import TumortrackError
from tumortrack_lab.bench.row import BenchRow
from tumortrack_lab.bench.subject import PRESETS
from tumortrack_lab.bench.turns import timing_of

if TYPE_CHECKING:
    from tumortrack_lab.bench.subject import Subject

NAME, LARGE = "`locate` command", "`locate --grid 400` command"
BEFORE_TORCH = "seconds before torch is imported"
PEAK = "peak bytes"
_GRIDS = {NAME: 160, LARGE: 400}
_FEWEST = 3
# Runs the command line and notes when torch is first asked for. Written out, so that nothing of
# ours is imported before the command line is.
_PROBE = """
import importlib.abc, sys, time
report = sys.argv.pop()
class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            sys.meta_path.remove(self)
            with open(report, "w") as out:
                out.write(str(time.monotonic()))
sys.meta_path.insert(0, Watch())
from tumortrack.cli.main import main
main()
"""
_LOOK_EVERY_S = 0.02  # at the process's peak memory


@dataclass(frozen=True)
class Ran:
    """One run of the command: seconds in all and before torch was imported, peak memory."""

    seconds: float
    before_torch_s: float
    peak_bytes: int


def rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """From the start of the process to its end, all files written; there is no naive form."""
    from tumortrack.sense.files import write_cloud_ply

    share = budget_s / len(PRESETS) / len(_GRIDS)
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            cloud = Path(folder) / f"{preset}.ply"
            write_cloud_ply(cloud, subject.cloud(preset).points_mm)
            model, out = subject.model_folder(preset), Path(folder) / "out"
            words = ["locate", model, cloud, out, "--overwrite", "--device", "cpu"]
            arguments = list(map(str, words))
            run_command(arguments)  # into the disk's cache
            for name, grid in _GRIDS.items():
                runs = _several([*arguments, "--grid", str(grid)], share)
                yield _row(name, preset, threads, runs)


def _several(arguments: list[str], budget_s: float) -> list[Ran]:
    runs: list[Ran] = []
    begun = time.perf_counter()
    while len(runs) < _FEWEST or (
        (time.perf_counter() - begun) * (len(runs) + 1) / len(runs) < budget_s
    ):
        runs.append(run_command(arguments))
    return runs


def _row(name: str, preset: str, threads: int, runs: list[Ran]) -> BenchRow:
    before = timing_of([ran.before_torch_s for ran in runs]).median_s
    peak = max(ran.peak_bytes for ran in runs)
    return BenchRow(
        name=name,
        what=preset,
        threads=threads,
        item="run",
        ours=timing_of([ran.seconds for ran in runs]),
        others={BEFORE_TORCH: before, PEAK: peak},
        note=f"{before:.2f} s before torch is imported, {peak / 2**30:.2f} GiB at most",
    )


def run_command(arguments: list[str]) -> Ran:
    """Run `tumortrack` with these arguments in a process of its own.

    Raises:
        TumortrackError: the command failed; its last words are told.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "asked.txt"
        start = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-c", _PROBE, *arguments, str(report)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        held = [0]
        looker = threading.Thread(target=_look, args=(process, held))
        looker.start()
        said = process.communicate()[0]
        seconds = time.monotonic() - start
        looker.join()
        if process.returncode != 0:
            words = said.strip().splitlines()[-1:] or ["nothing was said"]
            raise TumortrackError(f"`tumortrack {' '.join(arguments)}` failed: {words[0]}")
        before = float(report.read_text()) - start if report.exists() else seconds
    return Ran(seconds, before, held[0])


def _look(process: subprocess.Popen[str], held: list[int]) -> None:
    """Note a process's peak memory until its end. What the system tells of ended children
    (``ru_maxrss``) counts the memory of the parent that they were born of."""
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        try:
            text = status.read_text(encoding="ascii")
        except OSError:  # ended meanwhile, or no Linux
            return
        for line in text.splitlines():
            if line.startswith("VmHWM:"):
                held[0] = max(held[0], int(line.split()[1]) * 1024)
        time.sleep(_LOOK_EVERY_S)
