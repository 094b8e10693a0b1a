"""Two minutes with every kind of fault: a file of its own, for one worker."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from stories import environment

pytestmark = pytest.mark.slow


def test_every_fault_is_named_and_nothing_wrong_is_called_good(phantom_case, elastic_model):
    """The hour is `make soak`. On a loaded machine frames may be older, and answers take longer."""
    soak = Path(__file__).parents[2] / "benchmarks" / "scripts" / "soak.py"
    options = shlex.split("--minutes 1.95 --seed 2 --fps 5 --stale-s 1 --within-s 20 --wrong-mm 12")
    done = subprocess.run(
        [sys.executable, str(soak), str(elastic_model), str(phantom_case), *options],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
