"""Timing of the command line: `tumortrack` in its own process, files on a warm disk."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import TumortrackError
from tumortrack.imaging.nifti import write_nifti
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.sense.ply import write_cloud_ply
from tumortrack_lab.bench.rows import COMMAND, LARGE, METHOD, PATIENT, Workload
from tumortrack_lab.bench.subject import BenchSubject

_GRIDS = {COMMAND: 160, LARGE: 400}
# Runs the command line and writes down the process's peak memory (getrusage of an ended child
# includes the memory of the parent that it was forked from).
_PROBE = """
import os, sys
report, leave = sys.argv.pop(), os._exit
def report_and_leave(code):
    if os.path.exists("/proc/self/status"):
        lines = [line for line in open("/proc/self/status") if "VmHWM" in line]
        open(report, "w").writelines(lines)
    leave(code)
os._exit = report_and_leave  # which is how `locate` ends
from tumortrack.cli.main import main
main()
"""


def workloads(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """`locate`, from the start of the process to its end, all files written."""
    with tempfile.TemporaryDirectory() as folder:
        cloud, out = Path(folder) / "cloud.ply", Path(folder) / "out"
        write_cloud_ply(cloud, subject.cloud.points_mm)
        words = ["locate", subject.model_folder, cloud, out, "--overwrite", "--device", "cpu"]
        arguments = [*map(str, words)]
        run_command(arguments)  # into the disk's cache
        for name, grid in _GRIDS.items():
            yield _workload(name, [*arguments, "--grid", str(grid)])


def patient(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A new patient's labels to the first estimate: `prepare` and `locate`, a process each."""
    with tempfile.TemporaryDirectory() as folder:
        labels, cloud = Path(folder) / "labels.nii.gz", Path(folder) / "cloud.ply"
        phantom = phantom_labels(PhantomParameters(), voxel_mm=1.0)
        write_nifti(labels, phantom.labels, phantom.lps_from_index, lps=True)
        write_cloud_ply(cloud, subject.cloud.points_mm)
        runs: list[list[float]] = []

        def call() -> None:
            case, out = (Path(folder) / f"{name}-{len(runs)}" for name in ("case", "out"))
            steps = ("prepare", labels, case), ("locate", case, cloud, out)
            runs.append([run_command([*map(str, step)])[0] for step in steps])

        def facts() -> dict[str, str]:
            prepare_s, locate_s = np.median(runs[1:], axis=0)
            return {"note": f"prepare {prepare_s:.1f} s, locate {locate_s:.1f} s"}

        call()  # compiles
        yield Workload(PATIENT, METHOD, "patient", call, facts=facts)


def _workload(name: str, arguments: list[str]) -> Workload:
    peaks: list[int] = []

    def facts() -> dict[str, Any]:
        return {"peak_bytes": max(peaks), "note": f"{max(peaks) / 2**30:.2f} GiB at most"}

    return Workload(name, METHOD, "run", lambda: peaks.append(run_command(arguments)[1]), facts)


def run_command(arguments: list[str]) -> tuple[float, int]:
    """Run `tumortrack` with these arguments in a process of its own: seconds, and peak memory in
    bytes (0: unknown on this system). Raises TumortrackError: the command failed; the message
    quotes its last line."""
    with tempfile.NamedTemporaryFile("r") as report:
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, *arguments, report.name],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        seconds = time.monotonic() - start
        if done.returncode not in (0, 4):  # 4: the estimate is poor
            words = done.stdout.strip().splitlines()[-1:] or ["nothing was said"]
            raise TumortrackError(f"`tumortrack {' '.join(arguments)}` failed: {words[0]}")
        peak = report.read().split()  # VmHWM: N kB
    return seconds, 1024 * int(peak[1]) if peak else 0
