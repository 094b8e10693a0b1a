"""How often another kidney passes: mirror images, what lies behind, and what the block says."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from live_objects import small_anatomy
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.phantom.kidneys import random_anatomy
from tumortrack.sense.camera import d405
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.study.document import ReportWriter

NOTHING = SensorCloud(np.zeros((0, 3)))
SCRIPT = Path(__file__).parents[2] / "lab" / "scripts" / "foreign.py"


@pytest.fixture(scope="module")
def script() -> dict:
    return runpy.run_path(str(SCRIPT))


def test_a_mirror_image_is_as_large_turned_outward_and_on_the_other_side(script):
    anatomy, up = random_anatomy(1)
    mirrored = script["Organ"]("one", "one", anatomy, up).mirrored()
    for mine, other in zip(anatomy.parts, mirrored.anatomy.parts, strict=True):
        assert other.volume_mm3 == pytest.approx(mine.volume_mm3)
        np.testing.assert_allclose(other.box_mm[::-1, 0], -mine.box_mm[:, 0])
        np.testing.assert_allclose(other.box_mm[:, 1:], mine.box_mm[:, 1:])
    assert mirrored.up_lps == (-up[0], *up[1:])
    assert mirrored.patient == "one"


def test_the_table_lies_behind_the_organ_and_fills_no_hole_in_it(script):
    anatomy = small_anatomy()
    organ, camera = anatomy.organ, d405(212, 120)
    depth_mm = render_depth(organ.vertices_mm, organ.faces, camera).depth_mm.copy()
    row, column = np.argwhere(np.isfinite(depth_mm)).mean(0).astype(int)
    depth_mm[row, column] = np.nan  # the sensor has lost it
    seen = script["on_table"](Scene(NOTHING, anatomy, DepthFrame(depth_mm, camera))).depth_mm
    assert np.isnan(seen).sum() == 1
    beside = np.isnan(depth_mm) & np.isfinite(seen)
    assert beside.sum() > 1000
    assert np.unique(seen[beside]) == np.float32(organ.box_mm[1, 2])
    np.testing.assert_array_equal(seen[np.isfinite(depth_mm)], depth_mm[np.isfinite(depth_mm)])


def test_the_block_counts_what_was_called_good(script, tmp_path):
    def row(kind, state, verdicts, tumor_mm):
        table, nothing, cloud = verdicts.split()
        about = {"model": "m", "kind": kind, "organ": "o", "state": state, "cost": 0.5}
        seen = {"table": table, "nothing": nothing, "cloud": cloud}
        return {**about, **seen, "tumor_mm": tumor_mm, "target_mm": np.nan}

    rows = [
        row("own", "undeformed", "good good good", 0.2),
        row("foreign", "undeformed", "refused good poor", 44.0),
        row("foreign", "deformed", "refused poor refused", 80.0),
    ]
    document = tmp_path / "results.md"
    document.write_text("before\n<!-- results:foreign -->\n<!-- /results:foreign -->\nafter\n")
    script["_write"](
        pd.DataFrame(rows), {"m": 150.0}, script["Options"](), ReportWriter(document, "make it")
    )
    said = document.read_text()
    assert "| another's kidney | all | on a table | 2 | 2 | 0 | 0 | 0 (0 to 66) |" in said
    assert "| another's kidney | all | nothing seen behind | 2 | 0 | 1 | 1 | 50 (9 to 91) |" in said
    assert "| m | 150 | 1/1/1 of 1 | – | – | 0/1/0 of 2 |" in said
    assert "Of the 1 that any view called good and that are not the organ" in said
    assert "| m | o | undeformed | nothing seen behind | 44.0 | – | 0.50 |" in said
