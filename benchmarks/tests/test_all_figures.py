"""Every step of `make figures` runs, and writes the tables that the pages have: a miniature."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stories import environment

pytestmark = pytest.mark.slow


def test_every_figure_can_be_measured_again(tmp_path):
    script = Path(__file__).parents[1] / "scripts" / "figures.py"
    done = subprocess.run(
        [sys.executable, str(script), "--miniature", str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
