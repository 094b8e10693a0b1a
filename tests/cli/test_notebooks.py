"""The notebooks run as a reader runs them, and are kept without outputs."""

import os
import re
import shutil
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

FILES = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


def codes(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(cells: list[nbformat.NotebookNode]) -> str:
    return "".join(o.text for cell in cells for o in cell.outputs if o.output_type == "stream")


def test_they_are_kept_without_outputs():
    assert len(FILES) == 4
    for file in FILES:
        for cell in codes(nbformat.read(file, 4)):
            assert not cell.outputs
            assert cell.execution_count is None


@pytest.fixture(scope="module")
def ran(tmp_path_factory, ready_case):
    """What each notebook's cells print: one kernel for all, emptied in between."""
    folder = tmp_path_factory.mktemp("notebooks")
    shutil.copytree(ready_case, folder / "case")
    notebooks = [nbformat.read(file, 4) for file in FILES]
    forget = nbformat.v4.new_code_cell("%reset -f")
    joined = nbformat.v4.new_notebook()
    joined.cells = [cell for book in notebooks for cell in (*codes(book), forget)]
    environment = os.environ | {"TUMORTRACK_DEMO": str(folder), "MPLBACKEND": "agg"}
    NotebookClient(joined, timeout=300, kernel_name="python3").execute(cwd=folder, env=environment)
    return [codes(notebook) for notebook in notebooks]


def test_a_tumor_is_located(ran):
    assert "kidney: 1" in printed(ran[0])  # ml
    off = [line for line in printed(ran[0]).splitlines() if line.startswith("tumor_1: centre off")]
    assert 0 < float(off[0].split()[4]) < 5
    assert any("image/png" in o.data for cell in ran[0] for o in cell.outputs if "data" in o)


def test_estimates_stand_beside_the_best_rigid_pose(ran):
    rows = [line.split() for line in printed(ran[1]).splitlines() if line[:5].strip().isdigit()]
    assert len(rows) == 4
    off, bound, rigid = np.array([row[2:] for row in rows], float).reshape(-1, 3).T
    assert (bound > 0).all()
    assert (rigid > 0).any()  # the scenes are deformed
    assert rigid.max() < 5  # mildly
    assert np.median(off) < 5
    assert "a ball: " in printed(ran[1])
    assert "a ball: good" not in printed(ran[1])


def test_a_moving_organ_is_followed_in_a_notebook(ran):
    said = printed(ran[2])
    assert int(said.split(" estimates")[0]) >= 6
    moved = float(said.split("tumor 1 moved by ")[1].split()[0])
    assert moved > 0.05
    assert said.count("is CT") == 3


def test_touches_make_a_hidden_half_surer_and_a_wrong_one_is_named(ran):
    said = printed(ran[3])
    stated = r"tumor_\d: its centre is ([\d.]+) mm off; stated: off by at most ([\d.]+) mm"
    lines = re.findall(stated, said)
    off_mm, bounds_mm = np.array(lines, float).reshape(3, 2, 2).T  # without, with three, with six
    assert (off_mm < 5).all()
    assert (off_mm > 0).any()
    assert (bounds_mm[:, 2] < bounds_mm[:, 0]).all()
    assert "touch 7" in said
    assert said.count("rejected\n") == 1
