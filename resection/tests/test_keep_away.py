from dataclasses import replace

import numpy as np
import pytest

from plan_objects import RADIUS_MM, TUMOR_MM, located, sphere
from tumortrack.core.errors import InputError, NoPlan
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.values import ResectionConfig

MARGIN_MM, APART_MM = 5.0, 2.0


def beside(off_mm: float):
    """With a ball of 1 mm radius in the organ, so far beyond the margin."""
    away = RADIUS_MM + MARGIN_MM + off_mm + 1.0
    ball = sphere(TUMOR_MM + [0.0, away, 0.0], 1.0)
    return replace(located(), structures={"artery": ball})


@pytest.mark.parametrize("method", ["margin", "published"])
def test_a_cut_that_comes_too_near_to_a_structure_is_no_plan(method):
    config = ResectionConfig(method=method, margin_mm=MARGIN_MM)
    seen = beside(APART_MM)
    free = plan_resection(seen, config)
    assert "Nothing keeps the cuts away from artery." in free.notes
    path_mm = np.concatenate([cut.path_mm for cut in free.cuts])
    nearest = np.linalg.norm(path_mm - seen.structures["artery"].box_mm.mean(0), axis=1).min() - 1
    assert nearest < APART_MM + 2  # which the strokes alone can be; walls are sampled as well
    with pytest.raises(NoPlan, match=r"within [0-2]\.\d mm of artery, at x"):
        plan_resection(seen, ResectionConfig(method=method, keep_away={"artery": 3.0}))
    far = plan_resection(beside(12.0), ResectionConfig(method=method, keep_away={"artery": 3.0}))
    assert len(far.cuts) == len(free.cuts)
    assert not any("artery" in note for note in far.notes)


def test_what_cannot_be_kept_away_from_is_refused():
    with pytest.raises(InputError, match=r"--keep-away .*no such structure.* It has: artery"):
        plan_resection(beside(2.0), ResectionConfig(keep_away={"vein": 3.0}))
    for mm in (0.0, -1.0, 51.0, float("nan")):
        with pytest.raises(InputError, match="keep_away"):
            ResectionConfig(keep_away={"artery": mm})
