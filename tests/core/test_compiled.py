"""Machine code that is kept, and what becomes of it when the program changes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

KERNEL = """
from typing import NamedTuple
from tumortrack.core.compiled import numba
from {home} import Pair

@numba.njit(cache=True)
def total(pair):
    return pair.one + pair.other
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    one: float
    other: float
"""


def run(folder, home):
    code = f"from kernel import total; from {home} import Pair; print(total(Pair(1.0, 2.0)))"
    environment = {**os.environ, "PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}"}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=folder
    )
    assert done.stdout.strip() == "3.0", done.stderr


@pytest.mark.parametrize("damage", [None, b"", b"\x80\x05garbage"])
def test_a_class_that_moved_and_a_damaged_file_cost_a_compilation_and_no_more(tmp_path, damage):
    (tmp_path / "before.py").write_text(PAIR)
    (tmp_path / "kernel.py").write_text(KERNEL.format(home="before"))
    run(tmp_path, "before")
    kept = sorted((tmp_path / "__pycache__").glob("*.nb?"))
    assert {path.suffix for path in kept} == {".nbi", ".nbc"}
    if damage is None:
        (tmp_path / "before.py").rename(tmp_path / "after.py")
        (tmp_path / "kernel.py").write_text(KERNEL.format(home="after"))
        run(tmp_path, "after")
        return
    for path in kept:
        path.write_bytes(damage)
        run(tmp_path, "before")
