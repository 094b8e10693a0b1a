"""An organ under a holder's pull: the laws of its states, and what the study makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.sense.camera import d405
from tumortrack_lab.study import pulls
from tumortrack_lab.world.pulled import CUP_MM, Held
from tumortrack_lab.world.views import View
from world_objects import ANATOMY, organ

UP = np.array([0.0, 0.0, 1.0])
PULLS_MM = [0.0, 2.0, 4.0]


def above_the_tumor() -> np.ndarray:
    surface = organ().points_mm
    near = np.linalg.norm(surface[:, :2] - ANATOMY.tumors[0].vertices_mm.mean(0)[:2], axis=1) < 6
    return surface[near][surface[near][:, 2].argmax()]


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_what_the_cup_holds_goes_with_it_and_the_rest_follows_the_less_the_farther_it_is(
    seed: int | None,
) -> None:
    rng = np.random.default_rng(seed)
    held = Held.plain(organ()) if seed is None else Held.random(organ(), rng)
    grip_mm, surface = above_the_tumor(), organ().points_mm
    states = held.pulled(grip_mm, UP, PULLS_MM)
    rest, half, full = ((state.carry(surface) - surface)[:, 2] for state in states)
    assert np.abs(rest).max() < 1e-9
    far_mm = np.linalg.norm(surface - grip_mm, axis=1)
    gripped = far_mm < CUP_MM / 2
    assert full[gripped].mean() == pytest.approx(4.0, abs=0.5)
    rings = [full[(far_mm >= a) & (far_mm < a + 15)].mean() for a in (0, 15, 30, 45)]
    assert (np.diff(rings) < 0).all()
    assert half == pytest.approx(full / 2, abs=0.1)  # so few states are enough
    tumor = ANATOMY.tumors[0].vertices_mm
    risen = (states[-1].carry(tumor) - tumor)[:, 2].mean()
    assert 0.2 * 4.0 < risen < 4.0


def test_no_point_that_the_cup_hides_is_the_organs() -> None:
    camera_from_bench = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_bench[:3, 3] = [0.0, 0.0, 200.0]
    flat = np.stack(np.meshgrid(np.arange(-40.0, 41, 4), np.arange(-40.0, 41, 4)), -1).reshape(
        -1, 2
    )
    bench_mm = np.column_stack([flat, np.zeros(len(flat))])
    cloud = SensorCloud(transform_points(camera_from_bench, bench_mm).astype(np.float32))
    frame = DepthFrame(np.full((240, 424), 200.0, np.float32), d405(424, 240))
    left = pulls._beside(np.zeros(3), View(frame, camera_from_bench, {}), cloud)
    far = np.linalg.norm(left.points_mm[:, :2], axis=1)
    assert far.min() > CUP_MM
    assert far.min() < CUP_MM + 6
    assert len(left.points_mm) > 0.9 * len(flat)


def test_the_table_counts_what_the_cuts_did_by_pull_and_way() -> None:
    asked = {"number": 0, "tumor": "tumor_1", "planner": "5 mm", "off_mm": 1.0, "good": True}
    cut = {"removed_share": 1.0, "cut_share": 0.0, "healthy_ml": 9.0, "kerf_area_mm2": 3210.0}
    cut |= {"left_out": False}
    rows = [
        {**asked, **cut, "pull_mm": 4.0, "how": "pull", "margin_mm": -2.0, "cut_share": 0.125},
        {**asked, **cut, "pull_mm": 4.0, "how": "pull", "margin_mm": 5.0, "off_mm": 3.0},
        {**asked, "pull_mm": 4.0, "how": "pull", "refused": "no estimate"},
        {**asked, **cut, "pull_mm": 4.0, "how": "pull, held", "margin_mm": 4.6, "left_out": True},
    ]
    seen, held = pulls.table(rows).to_dict("records")
    assert (seen["followed by"], held["followed by"]) == ("pull", "pull, held")
    assert (seen["asked"], seen["plans"], seen["cut into it"], seen["as asked"]) == (3, 2, 1, 1)
    assert (seen["worst mm"], seen["margin kept median mm"]) == ("-2.0", "1.5")
    assert (seen["healthy tissue mean ml"], seen["kerf area mean cm2"]) == ("9.0", "32.1")
    assert (seen["cut worst %"], held["cut worst %"]) == ("12.5", "0.0")
    assert (held["asked"], held["left out"], held["as asked"]) == (1, 1, 1)
