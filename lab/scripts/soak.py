"""Hours of tracking: does memory grow, do frames get late, does the estimate stay right?

    make soak ARGS="MODEL CASE [--minutes 60] [--fps 30] [--sinks viewer:8090 ...]"

Runs `tumortrack track` on a moving case, keeps its report, and prints what became of memory
(after the first minute), latency, dropped frames and errors. Fails if memory grew by more than
20 MB, if a defect was met, or if a tumor's centre was off by more than --error mm (median).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

GROWN_MB = 20.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path, nargs="?", default=Path("runs/demo/model"))
    parser.add_argument("case", type=Path, nargs="?", default=Path("runs/demo/case"))
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--error", type=float, default=3.0, help="largest median error, mm")
    parser.add_argument("--stale", type=float, default=0.5, help="answers so late are none, s")
    parser.add_argument("--sinks", nargs="*", default=[])
    parser.add_argument("--report", type=Path, default=None)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tumortrack-soak-") as folder:
        report = options.report or Path(folder) / "report.json"
        source = f"virtual:{options.case}?fps={options.fps:g}"
        command = [sys.executable, "-m", "tumortrack.cli.main", "track", options.model, source]
        command += [*options.sinks, "--seconds", 60 * options.minutes, "--report", report]
        command = [*map(str, command), "--stale", str(options.stale)]
        print(" ".join(command), flush=True)
        if subprocess.run(command).returncode:
            return 1
        found = json.loads(report.read_text())
    problems = judge(found, options.error)
    print(table(found), *(f"FAILED: {problem}" for problem in problems), sep="\n")
    return int(bool(problems))


def judge(found: dict, most_mm: float) -> list[str]:
    """What is wrong with a run's report; nothing, if all is well."""
    problems, memory = [], found["memory_mb"]
    if "settled" not in memory:
        problems.append("the run was too short to tell whether memory grows; give 1.5 minutes")
    elif memory["now"] - memory["settled"] > GROWN_MB:
        problems.append(f"memory grew from {memory['settled']} to {memory['now']} MB")
    if found["defects"]:
        problems.append(f"internal errors: {found['defects'][0]}")
    if not found["center_error_mm"]:
        problems.append("there was no estimate")
    for name, errors in found["center_error_mm"].items():
        if errors["p50"] > most_mm:
            problems.append(f"{name} was off by {errors['p50']} mm (median)")
    for name, sink in found["sinks"].items():
        if sink["errors"]:
            problems.append(f"sink {name}: {sink['errors']} errors, last: {sink['last_error']}")
    return problems


def table(found: dict) -> str:
    """The run in a few lines."""
    latency, memory, good = found["latency_ms"], found["memory_mb"], found["estimates"]
    percentiles = ", ".join(f"{key} {latency[key]}" for key in ("p50", "p95", "p99.9", "max"))
    rows = {
        "seconds": f"{found['seconds']:.0f}",
        "estimates": f"{good['good']} good, {good['poor']} poor, {found['no_estimate']} none",
        "frames dropped": str(found["dropped"]),
        f"latency from {found['latency_from']}, ms": percentiles,
        "memory, MB": f"{memory['start']} at start, {memory.get('settled')} after a minute, "
        f"{memory['now']} at the end",
    }
    for name, errors in found["center_error_mm"].items():
        rows[name] = f"centre off by {errors['p50']} mm (median), {errors['p95']} (95 %)"
    for name, sink in found["sinks"].items():
        late = f"p50 {sink['latency_ms'].get('p50')}, p99.9 {sink['latency_ms'].get('p99.9')} ms"
        rows[name] = f"{sink['delivered']} delivered, {sink['dropped']} dropped, {late}"
    return "\n".join(f"{name:20} {row}" for name, row in rows.items())


if __name__ == "__main__":
    sys.exit(main())
