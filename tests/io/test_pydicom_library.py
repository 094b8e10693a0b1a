"""A user's module or folder ``dl`` is neither taken for Python 2's nor hidden from its owner."""

import subprocess
import sys

import pytest

PROGRAM = """
from tumortrack.io.pydicom_library import load_pydicom
load_pydicom()
import dl, pydicom
print(getattr(dl, "MINE", "a folder"))
"""


@pytest.mark.parametrize("said", ["42", "a folder"])
def test_a_users_own_dl_stays_theirs(tmp_path, said):
    if said == "42":
        (tmp_path / "dl.py").write_text("MINE = 42\n")
    else:
        (tmp_path / "dl").mkdir()
    (tmp_path / "program.py").write_text(PROGRAM)
    command = [sys.executable, tmp_path / "program.py"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.stdout.strip(), done.returncode) == (said, 0), done.stderr
