"""Workloads of the command line: `tumortrack locate` as its own process, files on a warm disk."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tumortrack.core.errors import TumortrackError
from tumortrack.sense.ply import write_cloud_ply
from tumortrack_lab.bench.machine import status_bytes
from tumortrack_lab.bench.rows import (
    BEFORE_TORCH,
    COMMAND,
    LARGE,
    PEAK,
    PRESETS,
    Workload,
    timing_of,
)
from tumortrack_lab.bench.subject import BenchSubject

_GRIDS = {COMMAND: 160, LARGE: 400}
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


class CommandRun(NamedTuple):
    """One run of the command: seconds in all and before torch was imported, peak memory."""

    seconds: float
    before_torch_s: float
    peak_bytes: int


def workloads(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
    """From the start of the process to its end, all files written; there is no naive form."""
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            cloud, out = Path(folder) / f"{preset}.ply", Path(folder) / "out"
            write_cloud_ply(cloud, subject.cloud(preset).points_mm)
            words = ["locate", subject.model_folder(preset), cloud, out, "--overwrite"]
            arguments = [*map(str, words), "--device", "cpu"]
            run_command(arguments)  # into the disk's cache
            for name, grid in _GRIDS.items():
                yield _workload(name, preset, [*arguments, "--grid", str(grid)], budget_s)


def _workload(name: str, preset: str, arguments: list[str], budget_s: float) -> Workload:
    runs: list[CommandRun] = []
    begun = time.perf_counter()
    while len(runs) < _FEWEST or (
        (time.perf_counter() - begun) * (len(runs) + 1) / len(runs) < budget_s
    ):
        runs.append(run_command(arguments))
    seconds, before, peaks = zip(*runs, strict=True)
    before_s, peak = timing_of([*before]).median_s, max(peaks)
    facts = {
        "others": {BEFORE_TORCH: before_s, PEAK: peak},
        "note": f"{before_s:.2f} s before torch is imported, {peak / 2**30:.2f} GiB at most",
    }
    return Workload(name, preset, "run", timing_of([*seconds]), facts=lambda: facts)


def run_command(arguments: list[str]) -> CommandRun:
    """Run `tumortrack` with these arguments in a process of its own. Raises TumortrackError: the
    command failed, the message says its last words."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "imported.txt"
        command = [sys.executable, "-c", _PROBE, *arguments, str(report)]
        start, held = time.monotonic(), [0]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        looker = threading.Thread(target=_look, args=(process, held))
        looker.start()
        output = process.communicate()[0]
        seconds = time.monotonic() - start
        looker.join()
        if process.returncode != 0:
            words = output.strip().splitlines()[-1:] or ["nothing was said"]
            raise TumortrackError(f"`tumortrack {' '.join(arguments)}` failed: {words[0]}")
        before = float(report.read_text()) - start if report.exists() else seconds
    return CommandRun(seconds, before, held[0])


def _look(process: subprocess.Popen[str], held: list[int]) -> None:
    """Note a process's peak memory until its end. What the system tells of ended children
    (``ru_maxrss``) counts the memory of the parent that they were born of."""
    while process.poll() is None:
        try:
            held[0] = max(held[0], status_bytes("VmHWM", process.pid))
        except OSError:  # ended meanwhile, or no Linux
            return
        time.sleep(_LOOK_EVERY_S)
