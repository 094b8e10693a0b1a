"""The cache of machine code, and what becomes of it when the program changes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

KERNEL = """
from typing import NamedTuple
from tumortrack.core.compiled import njit
from {home} import Pair

@njit()
def total(pair):
    return pair.one + pair.other
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    one: float
    other: float
"""


def printed(folder, code):
    """What a new process prints, which may find cached machine code; or its error."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}:{os.environ.get('PYTHONPATH', '')}"}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=folder
    )
    return done.stdout.strip() or done.stderr


def run(folder, home):
    code = f"from kernel import total; from {home} import Pair; print(total(Pair(1.0, 2.0)))"
    assert printed(folder, code) == "3.0"


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


TOTAL = """
from tumortrack.core.compiled import njit

@njit()
def total(values):
    total = 0.0
    for value in values:
        total += FACTOR * value
    return total
"""


def total_of(folder, kind):
    """The sum of 1, 2, 3."""
    code = f"import numpy, kernel; print(kernel.total(numpy.array([1, 2, 3], numpy.{kind})))"
    return printed(folder, code)


def test_machine_code_for_other_types_of_arguments_is_not_taken(tmp_path):
    """As left by two processes that compile the same function at once: both choose the same file
    name, and the index is from one, the code from the other."""
    (tmp_path / "kernel.py").write_text(TOTAL.replace("FACTOR", "1"))
    left = {}
    for kind in ("float32", "float64"):
        assert total_of(tmp_path, kind) == "6.0"
        left[kind] = {path: path.read_bytes() for path in (tmp_path / "__pycache__").glob("*.nb?")}
        for path in left[kind]:
            path.unlink()
    assert left["float32"].keys() == left["float64"].keys()
    for path, content in left["float64"].items():
        path.write_bytes(content if path.suffix == ".nbi" else left["float32"][path])
    assert total_of(tmp_path, "float64") == "6.0"
    assert total_of(tmp_path, "float32") == "6.0"


def test_machine_code_of_older_source_is_not_taken(tmp_path):
    """As left by a process that is killed after writing the index."""
    (tmp_path / "kernel.py").write_text(TOTAL.replace("FACTOR", "1"))
    assert total_of(tmp_path, "float64") == "6.0"
    (code,) = (tmp_path / "__pycache__").glob("*.nbc")
    older = code.read_bytes()
    # Of another length: Python's own cache goes by length and whole seconds.
    (tmp_path / "kernel.py").write_text(TOTAL.replace("FACTOR", "2.00"))
    assert total_of(tmp_path, "float64") == "12.0"
    code.write_bytes(older)
    assert total_of(tmp_path, "float64") == "12.0"


@pytest.mark.parametrize(
    ("part", "asked"),
    [("@njit()\ndef part(): return 1.0", "part()"), ("part = 1.0", "part")],
)
def test_machine_code_is_outdated_when_a_part_of_another_module_has_changed(tmp_path, part, asked):
    before = f"from tumortrack.core.compiled import njit\n\n{part}\n"
    (tmp_path / "other.py").write_text(before)
    importing = "from other import part\n" + TOTAL.replace("FACTOR", asked)
    (tmp_path / "kernel.py").write_text(importing)
    assert total_of(tmp_path, "float64") == "6.0"
    (tmp_path / "other.py").write_text(before.replace("1.0", "2.00"))
    assert total_of(tmp_path, "float64") == "12.0"
