"""An hour of tracking with injected faults.

    make soak ARGS="MODEL CASE [--minutes 60] [--seed 0] [--table FILE]"

A simulated case in motion is tracked by `track`'s own loop into four sinks: viewer, recorder, ROS 2
and OpenIGTLink (with a client that reads). At random moments faults are injected, of the kinds in
`tumortrack_lab/soak/faults.py`. It fails if an estimate that was called good was stale or wrong, a
fault was not named in its words in time, no good estimate came after it, memory grew by
over 20 MB after the first minute, an internal error was met, or a tape that a full disk cut off
cannot be read to its last second.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from tumortrack_lab.soak.run import SoakConfig, soak
from tumortrack_lab.study.scripts import run


def main(config: SoakConfig) -> None:
    os.environ.setdefault("ROS_DOMAIN_ID", "47")
    with tempfile.TemporaryDirectory(prefix="tumortrack-soak-") as folder:
        text, problems = soak(config, Path(folder))
    if config.table:
        config.table.write_text(text)
    print(text, *(f"FAILED: {problem}" for problem in problems), sep="\n")
    sys.exit(bool(problems))


if __name__ == "__main__":
    run(main, SoakConfig)
