"""Fits that are told parts of the truth: against answers that are known, and as a ladder."""

from __future__ import annotations

import runpy
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from elastic_objects import SMALL, UP
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, LabelVolume, SensorCloud
from tumortrack.imaging.case import Case
from tumortrack.registration.rest_shape import shape_of
from tumortrack.simulate.elastic.body import build_body
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.peers.base import fit_over_volume
from tumortrack_lab.world import causes
from tumortrack_lab.world.causes import CERTAIN, Told
from warp_objects import ANATOMY, placed, shape
from world_objects import ANATOMY as BENCHED
from world_objects import organ

CAMERA_FROM_BENCH = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 180.0]))  # looks down
BENCH_FROM_CT = np.linalg.inv(CAMERA_FROM_BENCH) @ placed(share=0.0).camera_from_ct
SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "lab/scripts/causes.py"))


def moved(rest: Anatomy, how) -> Anatomy:
    return Anatomy(tuple(part.moved(how(part.vertices_mm)) for part in rest.parts))


def told(motion) -> Told:
    """A motion of the slim organ as a state: its lower half is in the bed."""
    true = moved(ANATOMY, motion.carry)
    middle = transform_points(np.linalg.inv(CAMERA_FROM_BENCH), true.organ.vertices_mm)[:, 2].mean()
    return Told(ANATOMY, true, CAMERA_FROM_BENCH, BENCH_FROM_CT, float(middle))


def on_bench(how) -> Told:
    """The world's small organ, moved on its bench."""
    true = moved(BENCHED, lambda points: transform_points(CAMERA_FROM_BENCH, how(points)))
    return Told(BENCHED, true, CAMERA_FROM_BENCH, np.eye(4), 12.0)


def seen(state: Told) -> dict:
    return causes.evidence(state, np.random.default_rng(0))


def test_a_map_that_is_off_by_a_known_way_is_off_by_its_length() -> None:
    off = told(placed()).off_mm(lambda points: placed().carry(points) + [0.3, -0.4, 1.2])
    assert off == pytest.approx([1.3])


def test_evidence_is_what_cameras_above_the_bed_can_see() -> None:
    state = told(placed())
    given, to_bench = seen(state), np.linalg.inv(CAMERA_FROM_BENCH)
    noisy = given.pop("calibrated")
    height = {"calibrated": transform_points(to_bench, noisy)[:, 2] - state.rim_mm}
    for name, pairs in given.items():
        assert np.abs(placed().carry(pairs.points_ct) - pairs.points_mm).max() < 0.3  # chords
        height[name] = transform_points(to_bench, pairs.points_mm)[:, 2] - state.rim_mm
    assert min(height[name].min() for name in ("three views", "one view", "calibrated")) >= 0
    for name in ("whole surface", "one view and the underside"):
        assert height[name].min() < -15  # the bed is so deep
    off_mm = placed().residual_rows(noisy)[:, -1]  # to the surface
    assert 0.05 < np.median(np.abs(off_mm)) < 0.3


def test_a_state_of_the_library_is_found_again_and_less_told_leaves_more_open() -> None:
    off: dict[tuple[str, str], list[float]] = {}
    for number in range(5, 80, 8):
        truth = placed(number)
        state = told(truth)
        given, still = seen(state), replace(truth, coefficients=0 * truth.coefficients)
        found = causes.recognised(still, given["whole surface"], CERTAIN)
        motions = {("", "undeformed"): still, ("", "recognised"): found}
        motions["", "modes"] = causes.best_of_modes(shape(), state)
        for name, one in given.items():
            motions |= {(name, what): fit for what, fit in causes.fits(truth, one, {}).items()}
        for rung, motion in motions.items():
            off.setdefault(rung, []).extend(state.off_mm(motion.carry))
    mean = {rung: float(np.mean(each)) for rung, each in off.items()}
    assert mean["", "undeformed"] > 0.8  # what there is to find
    assert max(mean["", "recognised"], mean["", "modes"]) < 0.03
    names = "whole surface", "three views", "one view", "calibrated"
    used = [mean[name, "as used"] for name in names]
    assert used == sorted(used)
    assert used[-1] > 1.4 * used[0]
    assert used[0] > 0.2  # the prior's mean draws, all that is seen notwithstanding
    assert mean["one view and the underside", "as used"] < mean["one view", "as used"]
    for less in ("pose told", "points weigh more", "places recognised"):
        assert mean["one view", less] < 0.6 * mean["one view", "as used"]


def test_finite_elements_within_follow_the_surface_and_nothing_else() -> None:
    def stretched(points):  # volume is kept: every inner point's place is known
        return points * [1.1, 1 / 1.1 / 0.95, 0.95]

    state = on_bench(stretched)
    pose = fit_over_volume(state.rest.organ, state.true.organ)[0]
    assert state.off_mm(lambda points: transform_points(pose, points))[0] > 1.5
    assert state.off_mm(causes.inside_of(organ(), state, seen(state)["whole surface"]))[0] < 0.05
    inner = on_bench(lambda points: points)
    pulled = inner.true.tumors[0].moved(inner.true.tumors[0].vertices_mm + [1.5, 0.0, 2.0])
    hidden = replace(inner, true=Anatomy((inner.true.organ, pulled)))
    carry = causes.inside_of(organ(), hidden, seen(hidden)["whole surface"])
    assert hidden.off_mm(carry) == pytest.approx([2.5], abs=0.02)


@cache
def priors() -> causes.Priors:
    labels = LabelVolume(np.ones((2, 2, 2), np.uint8), np.eye(4))
    return causes.Priors(Case(ANATOMY, labels, UP), shape(), SMALL)


def test_priors_exchange_what_they_say() -> None:
    body, material = shape().body, {"tumor_ratio": 1.1, "poisson": 0.46}
    others = 3.0 + np.random.default_rng(0).normal(size=(40, body.states.shape[1]))
    soft = priors().exchanged(material, others, others[:0])
    stiff = priors().exchanged({"tumor_ratio": 9.0, "poisson": 0.49}, others, others)
    far = soft["states spread 2 times as far"].body
    assert np.allclose(far.covariance, 4 * body.covariance, atol=1e-3)
    assert np.allclose(far.mean, body.mean, atol=1e-3)
    mixed = 0.2 * body.mean + 0.8 * others.mean(0)
    assert np.allclose(soft["this world's states"].body.mean, mixed, atol=1e-3)
    strain, tumor = {}, ANATOMY.tumors[0].vertices_mm
    middle = tumor.mean(0, keepdims=True)
    for name, one in (("soft", soft), ("stiff", stiff)):
        its = one["tumors as stiff as they are"].body
        apart = ((its.modes_at(tumor) - its.modes_at(middle)) * (tumor - middle)[..., None]).sum(1)
        strain[name] = float(np.square(apart @ its.states.T).mean())  # free of its turn
    assert strain["stiff"] < 0.9 * strain["soft"]


def test_rows_of_a_state_and_the_table_that_counts_them() -> None:
    class Lost(Tracker):
        def __init__(self) -> None: ...

        def follow(self, *given, **named):
            raise NoEstimate("nothing")

    sheared = np.array([[1.02, 0.05, 0.0], [0.0, 1.0, 0.0], [0.08, 0.0, 0.98]])
    state = on_bench(lambda points: points @ sheared.T)
    rest = shape_of(BENCHED, build_body(BENCHED, (0, 0, 1), SMALL, 0))
    cloud = SensorCloud(seen(state)["one view"].points_mm.astype(np.float32))
    scene = Scene(cloud, state.true, meta={"family": "plate"})
    rows = causes.judged(state, scene, {"": rest, "itself": rest}, organ(), Lost())
    by = {(row["told"], row["what"]): row["off_mm"] for row in rows}
    assert ("as it is seen", "found") not in by
    assert by["one view", "itself"] == by["one view", "as used"] > 0
    assert by["", "modes"] < by["", "rigid"]
    assert {row["site"] for row in rows} == {"endophytic"}
    doubled = pd.concat([pd.DataFrame(rows).assign(bend_mm=5.0, off_mm=mm) for mm in (1.0, 3.0)])
    table = SCRIPT["summary"](doubled)
    assert "| told | endophytic, D1 (2) | endophytic, D2 (0) | endophytic, D3 (0) |" in table
    assert "| what one view shows of it | 2.0 / 2.9 / 3.0 | - | - |" in table
    assert "found from nothing | - | - | - |" in table
