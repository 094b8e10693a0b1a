"""Steps of `make figures` run, and write the tables that the pages have: a miniature. Those that
take longest are left to `make figures ARGS="--miniature OUT"`; their scripts have tests."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stories import environment

pytestmark = pytest.mark.slow


STEPS = "accuracy", "noise", "stress", "speed"


def test_figures_can_be_measured_again(tmp_path):
    script = Path(__file__).parents[1] / "scripts" / "figures.py"
    done = subprocess.run(
        [sys.executable, str(script), *STEPS, "--miniature", str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
