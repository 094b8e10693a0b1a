"""Minutes of tracking, mostly spent waiting for frames: a file of its own, for one worker."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from stories import environment


def test_minutes_of_tracking_leave_memory_as_it_was(phantom_case, clinic_model):
    """The hour is `make soak`."""
    soak = Path(__file__).parents[2] / "lab" / "scripts" / "soak.py"
    sinks = ["openigtlink:0", "viewer:0"]
    options = ["--minutes", "1.5", "--fps", "8", "--error", "6", "--sinks", *sinks]
    done = subprocess.run(
        [sys.executable, str(soak), str(clinic_model), str(phantom_case), *options],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "after a minute" in done.stdout
