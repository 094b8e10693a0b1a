"""Minutes of tracking, mostly spent waiting for frames: a file of its own, for one worker."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stories import environment

pytestmark = pytest.mark.slow


def test_minutes_of_tracking_leave_memory_as_it_was(phantom_case, clinic_model):
    """The hour is `make soak`."""
    soak = Path(__file__).parents[2] / "lab" / "scripts" / "soak.py"
    sinks = ["openigtlink:0", "viewer:0"]
    options = ["--minutes", "1.5", "--fps", "8", "--error", "6", "--stale", "30"]
    done = subprocess.run(
        [
            sys.executable,
            str(soak),
            str(clinic_model),
            str(phantom_case),
            *options,
            "--sinks",
            *sinks,
        ],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "after a minute" in done.stdout
