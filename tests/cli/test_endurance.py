"""A small share of `make fuzz` and `make crash`."""

from __future__ import annotations

import subprocess
import sys

import pytest

import crashes
import fuzz
from stories import environment, succeeded, tumortrack


def test_damaged_input_is_read_or_refused(tmp_path):
    done = subprocess.run(
        [sys.executable, fuzz.__file__, "--inputs", "3000", "--keep", str(tmp_path)],
        capture_output=True,
        text=True,
        env=environment(),
    )
    assert "targets, 0 faults" in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
def test_killed_commands_leave_what_is_whole(tmp_path, phantom_case, clinic_model):
    base = tmp_path / "base"
    base.mkdir()
    (base / "case").symlink_to(phantom_case)
    (base / "model").symlink_to(clinic_model)
    succeeded(tumortrack("simulate", phantom_case, base / "scenes", "--scenes", 1))
    options = ["--times", "2", "--seed", "3", "--slim", "--only", "making", "locating", "recording"]
    done = subprocess.run(
        [sys.executable, crashes.__file__, str(tmp_path), *options],
        capture_output=True,
        text=True,
        env=environment(),
    )
    assert done.stdout.count("as it must be") == 3, done.stdout + done.stderr
