"""An hour of tracking with everything going wrong round it.

    make soak ARGS="MODEL CASE [--minutes 60] [--seed 0] [--table FILE]"

A simulated case in motion is tracked by `track`'s own loop into four sinks: viewer, recorder, ROS 2
and OpenIGTLink (with a client that reads). At random moments faults are injected, of the kinds in
`tumortrack_lab/soak/faults.py`. It fails if an estimate that was called good was stale or wrong, a
fault was not named in its words in time, no good estimate came after it, memory grew by
over 20 MB after the first minute, an internal error was met, or a tape that a full disk cut off
cannot be read to its last second.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

from tumortrack_lab.soak.run import SoakConfig, soak


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path, nargs="?", default=Path("runs/demo/model"))
    parser.add_argument("case", type=Path, nargs="?", default=Path("runs/demo/case"))
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stale", type=float, default=0.5, help="older frames are refused, s")
    parser.add_argument("--within", type=float, default=0.5, help="a fault must be named, s")
    parser.add_argument("--wrong", type=float, default=5.0, help="a part so far off is wrong, mm")
    parser.add_argument("--kinds", nargs="*", default=[], help="of faults alone, by their names")
    parser.add_argument("--table", type=Path, help="the Markdown tables, also printed")
    given = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", "47")
    config = SoakConfig(
        model=given.model,
        case=given.case,
        minutes=given.minutes,
        fps=given.fps,
        seed=given.seed,
        stale_s=given.stale,
        wrong_mm=given.wrong,
        within_s=given.within,
        kinds=tuple(given.kinds),
    )
    with tempfile.TemporaryDirectory(prefix="tumortrack-soak-") as folder:
        text, problems = soak(config, Path(folder))
    if given.table:
        given.table.write_text(text)
    print(text, *(f"FAILED: {problem}" for problem in problems), sep="\n")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
