"""Margins by scenes: what they cover, when there is no answer, and the table they come from."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from live_objects import CAMERA, small_anatomy, small_estimate
from reports import looked, reporting
from tumortrack.assessment.verdict import judged
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.types import SensorCloud
from tumortrack.report.metrics import distance_to_surface
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.margins import ModelMargins, evidence_words
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.margins.calibration import (
    Listed,
    answered,
    evidence_of,
    list_states,
    margins_of,
    row_of,
)
from tumortrack_lab.margins.table import Row, head_of, open_table

GROUPS = [(f, share, o) for f in ("plate", "poke") for share in ("far", "near") for o in ("x", "y")]


def drawn(rng, per_group, liars=0.0, groups=GROUPS):
    """States whose misses grow with s, more so in the family ``poke``; ``liars`` fit badly, and are
    ten times as far off."""
    rows = []
    for label in groups:
        for _ in range(per_group):
            lies = rng.random() < liars
            s = float(np.exp(0.3 * rng.normal()))
            hard = 2.0 if label[0] == "poke" else 1.0
            misses = hard * s * rng.exponential(size=2) * (10 if lies else 1)
            figures = {"fit_cost": float(rng.random() + lies), "unsure_mm": s}
            tumors = tuple((float(miss), s) for miss in misses)
            rows.append(Row(
                scene=str(rng.integers(1 << 60)), sha256="", label=label, measured=figures,
                misses={"tumor": tumors, "organ": tumors[:1]},
            ))  # fmt: skip
    return rows


def within(margins: ModelMargins, rows, confidence):
    """Of the accepted states, whether all tumors are within the radius."""
    radius = next(s for s in margins.shells if s.confidence == confidence).radii["tumor"]
    taken = [row for row in rows if answered(row, margins)]
    return [row.within("tumor", radius) for row in taken]


def test_every_group_is_covered_as_often_as_stated():
    """The mean over calibrations, as the promise is; the hardest group sets the radius and is not
    covered much oftener than it must be."""
    shares = {confidence: [] for confidence in (0.8, 0.9)}
    rng = np.random.default_rng(1)
    for seed in range(20):
        margins = margins_of(drawn(rng, 80), "", (0.8, 0.9), 20.0, seed)
        for confidence, share in shares.items():
            fresh = [drawn(rng, 60, groups=[label]) for label in GROUPS]
            share.append([np.mean(within(margins, rows, confidence)) for rows in fresh])
    for confidence, share in shares.items():
        means, errors = np.mean(share, 0), np.std(share, 0) / np.sqrt(len(share))
        assert (means >= confidence - 2 * errors).all()
        assert means.min() < confidence + 0.1


def test_the_form_with_the_smaller_mean_is_used():
    rng = np.random.default_rng(2)
    grows = margins_of(drawn(rng, 60), "", (0.8,), 20.0).shells[0].radii["tumor"]
    assert grows.used == "scaled"
    assert grows.at(2.0, {}) > 1.5 * grows.at(1.0, {})
    assert grows.at(None, {}) is None
    flat = [
        replace(row, misses={"tumor": ((float(rng.random()), row.measured["unsure_mm"]),)})
        for row in drawn(rng, 60)
    ]
    same = margins_of(flat, "", (0.8,), 20.0).shells[0].radii["tumor"]
    assert same.used == "constant"
    assert same.at(None, {}) == same.at(9.0, {}) <= 1.0
    unknown = [
        replace(row, misses={"tumor": tuple((miss, None) for miss, _ in row.misses["tumor"])})
        for row in drawn(rng, 60)
    ]
    radii = margins_of(unknown, "", (0.8,), 20.0).shells[0].radii
    assert (radii["tumor"].used, radii["tumor"].scaled) == ("constant", None)
    assert list(radii) == ["tumor"]


def test_organs_that_are_bent_far_have_wider_margins_where_they_miss_by_more():
    rng = np.random.default_rng(5)
    rows = []
    for row in drawn(rng, 60):
        rarity, s = float(rng.exponential(0.1)), row.measured["unsure_mm"]
        size = s + 6 * rarity**0.5
        tumors = tuple((float(size * rng.uniform()), s) for _ in range(2))
        figures = {**row.measured, "rarity": rarity}
        rows.append(replace(row, measured=figures, misses={"tumor": tumors}))
    radius = margins_of(rows, "", (0.9,), 20.0).shells[0].radii["tumor"]
    assert 3 <= radius.bend_mm <= 8
    straight, bent = (radius.at(1.0, {"rarity": rarity}) for rarity in (0.0, 0.25))
    assert bent - straight == pytest.approx(radius.scaled * radius.bend_mm * 0.5)
    assert radius.at(1.0, {}) == np.inf  # a method that knows no states is told nothing


def test_answers_that_lie_are_refused_by_limits_that_were_tested():
    rng = np.random.default_rng(4)
    margins = margins_of(drawn(rng, 200, liars=0.12), "", (0.9,), 10.0)
    assert margins.limits["fit_cost"] < 1.05  # liars begin at 1
    assert margins.risk_bound < 0.21
    assert 0.6 < margins.accepted < 0.9
    assert 0 < margins.missed < 0.1
    assert sum(group.accepted for group in margins.groups) < 0.9 * 200 * len(GROUPS)
    fresh = drawn(rng, 200, liars=0.12)
    assert np.mean(within(margins, fresh, 0.9)) > 0.9
    lying = [row for row in fresh if row.measured["fit_cost"] > 1.05]
    assert len(lying) > 50
    assert within(margins, lying, 0.9) == []


def test_poor_answers_count_for_nothing():
    rng = np.random.default_rng(4)
    rows = drawn(rng, 100)
    poor = [replace(row, doubt="no organ", measured={}, misses={}) for row in rows[::4]]
    margins = margins_of([*(row for n, row in enumerate(rows) if n % 4), *poor], "", (0.9,))
    assert margins.accepted < 0.76
    assert sum(group.good for group in margins.groups) == 600


class _Known(Tracker):
    """Finds ``small_anatomy`` in any cloud, and judges as every tracker does."""

    def __init__(self):
        pass

    def locate(self, cloud, grid, seed, seen=None, evidence=()):
        return judged(small_estimate(), looked(seen or cloud))


def test_a_partly_hidden_organ_is_judged_by_the_image_if_there_is_one(tmp_path):
    truth = small_anatomy()
    frame = render_depth(truth.organ.vertices_mm, truth.organ.faces, CAMERA)
    hidden = frame.depth_mm.copy()
    hidden[:, :32] = 90  # a hand before one half
    crop = CloudConfig(near_mm=50, far_mm=200, n_points=800)
    cloud = cloud_from_depth(frame, crop, np.random.default_rng(0))
    half = SensorCloud(cloud.points_mm[cloud.points_mm[:, 0] > 4])
    listed = Listed(tmp_path, ("plate", "far", "x"))
    alone = row_of(_Known(), Scene(half, truth), listed, 0)
    assert "the cloud has no points" in alone.doubt
    seen = row_of(_Known(), Scene(half, truth, frame.with_depth(hidden)), listed, 0)
    assert seen.doubt == ""
    assert 0.3 < seen.measured["unseen"] < 0.5  # a limit on it can be found all the same
    assert seen.score("tumor", None) < 1e-6
    behind = frame.depth_mm + np.where(np.arange(64) < 28, 40, 0).astype(np.float32)
    through = row_of(_Known(), Scene(half, truth, frame.with_depth(behind)), listed, 0)
    assert "sees through" in through.doubt


class _Using(_Known):
    """Says that it used all evidence, or all but one piece."""

    def __init__(self, left_out=0):
        self.left_out = left_out

    def locate(self, cloud, grid, seed, seen=None, evidence=()):
        self.given = evidence
        told = [
            {"name": each.name, "part": getattr(each, "part", ""), "off_mm": 1.0, "news": 0.5,
             "left_out": n < self.left_out}
            for n, each in enumerate(evidence)
        ]  # fmt: skip
        estimate = judged(small_estimate(), looked(seen or cloud))
        return reporting(estimate, evidence=told)


def test_a_state_is_located_with_evidence_drawn_for_it(tmp_path):
    truth, listed = small_anatomy(), Listed(tmp_path, ("plate", "far", "x"))
    frame = render_depth(truth.organ.vertices_mm, truth.organ.faces, CAMERA)
    crop = CloudConfig(near_mm=50, far_mm=200, n_points=800)
    scene = Scene(cloud_from_depth(frame, crop, np.random.default_rng(0)), truth, frame)
    asked, tracker = evidence_of("touch6+outline1"), _Using()
    row = row_of(tracker, scene, listed, 0, asked)
    assert (row.doubt, set(row.misses)) == ("", {"tumor", "organ"})
    first = tracker.given
    assert [each.name for each in first] == ["touch"] * 6 + ["outline"] * len(truth.tumors)
    assert {each.part for each in first[6:]} == set(truth.names[1:])
    places = np.array([each.place_mm for each in first[:6]])
    off_mm = np.abs(distance_to_surface(places, truth.organ))
    assert 0.01 < np.median(off_mm) < 5  # with the errors of tools
    row_of(tracker, scene, listed, 0, asked)
    assert tracker.given == first
    row_of(tracker, scene, listed, 1, asked)
    assert tracker.given != first
    row_of(tracker, scene, listed, 0)
    assert tracker.given == []
    assert not row_of(_Using(left_out=1), scene, listed, 0, asked).doubt  # as a user's may be
    with pytest.raises(InputError, match=r"need targets\.csv"):
        row_of(tracker, scene, listed, 0, {"held": 1})


def test_names_of_evidence():
    assert evidence_of("touch12+outline1") == {"outline": 1, "touch": 12}
    assert evidence_words(evidence_of("touch12+outline1")) == "outline1+touch12"
    for wrong in ("touch", "touches12", "touch0", "touch12+touch6", "free1", "", "touch12+"):
        with pytest.raises(InputError, match=r"is not allowed\. Allowed: touch1 to touch100"):
            evidence_of(wrong)


def test_too_few_states_are_refused_with_their_number_and_small_groups_join():
    rng = np.random.default_rng(3)
    with pytest.raises(
        InputError,
        match=r"8 mm: all states: 0 of 5\. If none does, about 180 scenes are needed, and 275 if",
    ):
        margins_of(drawn(rng, 20, groups=GROUPS[:1]), "", (0.9, 0.95))
    with pytest.raises(InputError, match="no good estimate among"):
        margins_of([replace(row, doubt="poor") for row in drawn(rng, 20)], "")
    uneven = drawn(rng, 100, groups=GROUPS[:4]) + drawn(rng, 3, groups=[("plate", "near", "z")])
    margins = margins_of(uneven, "", (0.9,))
    assert margins.joined == {"plate, near, z": "plate, near"}
    assert {group.label[2]: group.states for group in margins.groups}["z"] == 3
    rare = drawn(rng, 10, groups=[("cut", "near", "z")])
    margins = margins_of(uneven + rare, "", (0.9,))
    assert margins.joined["cut, near, z"] == "all states"
    wide = [replace(row, misses={"tumor": ((7.9, 1.0),)}) for row in rare]
    wider = margins_of(uneven + wide, "", (0.9,)).shells[0].radii["tumor"].constant_mm
    assert wider >= margins.shells[0].radii["tumor"].constant_mm


def test_a_table_goes_on_where_it_was_killed(tmp_path):
    path, head = tmp_path / "table.jsonl", head_of("abc", 0)
    first, second = drawn(np.random.default_rng(0), 1)[:2]
    with open_table(path, head) as (rows, add):
        assert rows == []
        add(first)
        with pytest.raises(InputError, match="filled by another process"), open_table(path, head):
            pass
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"scene": "un')  # killed while it wrote
    with open_table(path, head) as (rows, add):
        assert rows == [first]
        add(second)
    with open_table(path, head) as (rows, _):
        assert rows == [first, second]
    with (
        pytest.raises(InputError, match="begun with another model_sha256 and seed"),
        open_table(path, head_of("other", 1)),
    ):
        pass
    (tmp_path / "none").write_text("[1]\n{}\n")
    with pytest.raises(InputError, match="is not a table"), open_table(tmp_path / "none", head):
        pass


def test_a_table_of_margins_is_not_made_of_somebodys_notes(tmp_path):
    notes = tmp_path / "notes.txt"
    notes.write_text("first line\nno end of line")
    with pytest.raises(InputError, match="not a table"), open_table(notes, head_of("sha", 0)):
        pass
    assert notes.read_text() == "first line\nno end of line"


def test_a_table_whose_first_line_was_cut_short_is_begun_again(tmp_path):
    table, head = tmp_path / "margins.jsonl", head_of("sha", 0)
    with open_table(table, head):
        pass
    whole = table.read_bytes()
    table.write_bytes(whole[:10])
    with open_table(table, head) as (rows, _):
        assert rows == []
    assert table.read_bytes() == whole


def test_one_scene_of_each_state_counts(tmp_path):
    for n in range(6):
        (tmp_path / f"{n}").mkdir()
        (tmp_path / f"{n}" / "cloud.ply").touch()
        meta = {"family": "bed", "visible_share": 0.2 * n, "state": f"s{n // 2}"}
        store.write_json(tmp_path / f"{n}" / "meta.json", meta)
    listed = list_states([tmp_path], 0)
    assert sorted(int(one.folder.name) // 2 for one in listed) == [0, 1, 2]
    picks = {tuple(one.folder.name for one in list_states([tmp_path], seed)) for seed in range(20)}
    assert len(picks) > 4  # of 8
    words = {one.folder.name: one.label[1] for s in range(9) for one in list_states([tmp_path], s)}
    assert [words[str(n)] for n in range(6)] == [
        "under 1/3", "under 1/3", "1/3 to 2/3", "1/3 to 2/3", "over 2/3", "over 2/3",
    ]  # fmt: skip
    store.write_json(tmp_path / "0" / "meta.json", {"state": "other", "model_organ": False})
    assert len(list_states([tmp_path], 0)) == 3
    store.write_json(tmp_path / "0" / "meta.json", {"visible_share": 70})
    with pytest.raises(InputError, match="visible_share is 70; allowed: 0 to 1"):
        list_states([tmp_path], 0)
