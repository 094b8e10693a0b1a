"""What was cut of a followed organ is known to the end; its tracker knows it soon; till then, and
where nobody says where, no answer is good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clock import until
from elastic_objects import UP, bent, organ
from live_objects import small_setting
from tumortrack.core.errors import NoEstimate
from tumortrack.core.evidence import Cut, Touch
from tumortrack.core.types import DepthError, SensorCloud
from tumortrack.live.values import CameraView, Observation
from tumortrack.live.views import ViewsLocator
from tumortrack.registration.model import build_model
from tumortrack.registration.motion import ElasticMotion
from tumortrack.tracking.cuts import Cuts
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.tracker import Tracker, region_for
from warp_objects import slim_elastic

pytestmark = pytest.mark.slow
S = 1_000_000_000
HAND = SensorCloud(np.full((30, 3), 100.0))


@pytest.fixture(scope="module")
def tracker():
    """Of an organ that looks the same no other way round."""
    return Tracker(build_model(bent(organ(), 1.0), UP, slim_elastic()))


@pytest.fixture(scope="module")
def shell(tracker):
    """Places some 1 mm apart on half of a ball round the tumor, 5.75 mm off it, in the organ."""
    shape, rng = tracker.model.shape, np.random.default_rng(0)
    low, high = shape.anatomy_ct.tumors[0].box_mm
    places = rng.uniform(low - 8, high + 8, (60_000, 3))
    off_mm = shape.distances_mm(places, 1)
    half = places[:, 2] > (low + high)[2] / 2
    return places[half & (abs(off_mm - 5.75) < 0.3) & (shape.distances_mm(places, 0) < 0)]


@pytest.fixture
def follower(tracker):
    return Follower(tracker, FollowerConfig(rescan_s=1e6))


def lying(tracker, shift_mm=(0.0, 0.0, 0.0), degrees=0.0):
    """The organ at rest, seen from the front, moved from there."""
    shape = tracker.model.shape
    turn = Rotation.from_euler("xz", [90, degrees], degrees=True).as_matrix()
    middle_mm = np.array([0, 0, 200.0]) + shift_mm
    return ElasticMotion(shape, turn, middle_mm, shape.body.mean)


def seen(motion, at_s):
    """Its side towards the camera, at a time."""
    vertices_mm = motion.forward(motion.shape.anatomy_ct.organ.vertices_mm)
    near = vertices_mm[vertices_mm[:, 2] < np.median(vertices_mm[:, 2])]
    return SensorCloud(near.astype("f4"), int(at_s * S), depth_error=DepthError())


def cut(places_ct, motion=None, **more):
    if motion is None:
        return Cut(points_ct=tuple(map(tuple, places_ct.tolist())), **more)
    return Cut(places_mm=tuple(map(tuple, motion.forward(places_ct).tolist())), **more)


def kind(estimate):
    return estimate.finding and estimate.finding.kind


def test_from_the_first_cut_on_no_answer_is_good_until_it_knows_it(tracker, follower, shell):
    there = lying(tracker)
    before = follower.locate(seen(there, 1))
    assert before.quality == "good"
    assert before.report.cut is None
    quarter = shell[::4]
    new = follower.locate(seen(there, 1.1), evidence=[cut(quarter, there)])
    assert kind(new) == "cut_new"
    assert (new.report.cut.places, new.report.cut.known) == (0, follower.cuts.known)
    assert follower.locate(seen(there, 1.3)).quality == "poor"  # perhaps it goes on
    follower.locate(seen(there, 1.7))  # half a second later the leg is over
    known = follower.locate(seen(there, 1.8))
    assert known.quality == "good"
    assert known.report.cut.places == known.report.cut.known == follower.cuts.known
    assert tuple(known.report.cut.flaps) == ("tumor_1",)
    tumor = [each.meshes["tumor_1"].vertices_mm for each in (before, known)]
    off_mm = np.linalg.norm(tumor[1] - tumor[0], axis=1).max()
    assert off_mm < known.report.parts["tumor_1"].center_std_mm  # nothing moved
    # Once most is known, more of it is no news.
    more = follower.locate(seen(there, 1.9), evidence=[cut(shell[1::16], there)])
    assert more.quality == "good"
    assert more.report.cut.known > more.report.cut.places


def test_a_cut_is_never_forgotten(tracker, follower, shell):
    there = lying(tracker)
    follower.locate(seen(there, 1), evidence=[cut(shell, there, tool="hook")])
    known = follower.cuts.known
    assert known > len(shell) / 4
    follower.forget()
    follower.lose()
    with pytest.raises(NoEstimate):
        follower.locate(replace(HAND, stamp_ns=2 * S))
    follower.cuts.deny()
    hours = 1e4
    found = follower.locate(seen(there, hours))
    assert follower.cuts.known == found.report.cut.known == found.report.cut.places == known
    assert found.quality == "good"
    before = follower.locate(seen(there, hours - 5000))  # its clock was set back
    assert before.report.cut.places == known


def test_what_is_cut_again_and_air_add_nothing(tracker, follower, shell):
    there = lying(tracker)
    follower.locate(seen(there, 1), evidence=[cut(shell)])
    known = follower.cuts.known
    air = there.forward(shell) - [0, 0, 80]
    for n in range(20):
        again = [cut(shell[n::20]), Cut(places_mm=tuple(map(tuple, air.tolist())))]
        follower.locate(seen(there, 1.1 + n / 30), evidence=again)
    assert follower.cuts.known == known
    cubes = np.floor(np.array(follower.cuts.all.points_ct) / 1.5)
    assert len(np.unique(cubes, axis=0)) == known


def test_a_cut_is_carried_by_where_the_organ_lay(tracker, follower, shell):
    places = list[np.ndarray]()
    for n, (shift_mm, degrees) in enumerate([((0, 0, 0), 0), ((8, -6, 15), 20)]):
        there = lying(tracker, shift_mm, degrees)
        follower = Follower(tracker, FollowerConfig())
        follower.locate(seen(there, 1 + n))
        follower.locate(seen(there, 1.1 + n), evidence=[cut(shell, there)])
        places.append(np.array(follower.cuts.all.points_ct))
    for one in places:
        off_mm = np.linalg.norm(one[:, None] - shell, axis=2).min(1)
        assert np.percentile(off_mm, 95) < 2.0  # as far as the answer errs


@pytest.mark.parametrize(("again_s", "known"), [(1.8, True), (2.8, False)])
def test_a_cut_waits_for_an_answer_for_a_second(tracker, follower, shell, again_s, known):
    there = lying(tracker)
    follower.locate(seen(there, 1))
    with pytest.raises(NoEstimate):
        follower.locate(replace(HAND, stamp_ns=int(1.5 * S)), evidence=[cut(shell, there)])
    found = follower.locate(seen(there, again_s))
    assert (follower.cuts.known > 0) is known
    assert kind(found) == ("cut_new" if known else "cut_unknown")
    assert found.report.cut.unknown == (0 if known else 1)
    if not known:
        follower.cuts.deny()  # it was no cut, says the user
        assert follower.locate(seen(there, again_s + 0.1)).quality == "good"


def test_a_cut_that_is_told_without_a_place_makes_poor_until_one_says_it(tracker, shell):
    there, follower = lying(tracker), Follower(tracker, FollowerConfig(rescan_s=1e6))
    follower.locate(seen(there, 1))
    follower.cuts.tell()
    assert kind(follower.locate(seen(there, 1.1))) == "cut_unknown"
    follower.forget()
    assert kind(follower.locate(seen(there, 60.0))) == "cut_unknown"
    follower.locate(seen(there, 61.0), evidence=[cut(shell)])
    follower.locate(seen(there, 62.0))
    assert follower.locate(seen(there, 62.1)).quality == "good"


def test_a_user_says_that_it_is_cut_and_takes_it_back(tracker, follower):
    context = replace(small_setting(), anatomy_ct=tracker.anatomy_ct)
    views = ViewsLocator(follower, context, region_for(tracker.model, whole=True), 0.0, 0)

    def located(at_s):
        cloud = seen(lying(tracker), at_s)
        view = CameraView(1, Observation(cloud, cloud.stamp_ns), np.eye(4))
        return kind(views.locate(views.find([view], {}, {})[0]))

    assert located(1) is None
    context.controls.cut.set()
    assert located(1.1) == located(1.2) == "cut_unknown"
    assert views.cuts.summary()["told"]
    context.controls.acknowledged.set()
    assert located(1.3) is None
    assert views.cuts.summary() == {}


def test_frames_go_on_while_a_body_is_made(tracker, shell):
    there, follower = lying(tracker), Follower(tracker, FollowerConfig(rescan_s=1e6))
    follower.cuts.beside = True
    follower.locate(seen(there, 1), evidence=[cut(shell)])
    time_s, answers = 2.0, []

    def in_use():
        nonlocal time_s
        time_s += 0.033
        answers.append(follower.locate(seen(there, time_s)))
        return answers[-1].quality == "good"

    until(in_use, "a body that knows it")
    assert {kind(each) for each in answers[:-1]} == {"cut_new"}
    assert all(each.report.cut.places == 0 for each in answers[:-1])
    assert answers[-1].report.cut.places > 0
    assert answers[0].organ_mesh.faces.shape != answers[-1].organ_mesh.faces.shape


def test_a_tracker_of_an_organ_that_was_cut_begins_with_that(tracker, follower, shell):
    first = Cuts(tracker.with_cut([cut(shell[::2])]))
    assert first.known == len(np.unique(np.floor(shell[::2] / 1.5), axis=0))
    assert first.finding is None


def test_smoothing_leaves_out_what_was_before_a_cut(tracker, shell):
    there = lying(tracker)
    smooth = Follower(tracker, FollowerConfig(rescan_s=1e6, smoothing_s=1.0))
    smooth.locate(seen(there, 1), evidence=[cut(shell)])
    smooth.locate(seen(there, 2))
    new = smooth.locate(seen(there, 2.1))
    assert new.report.smoothing.lag_ms == 0
    assert smooth.locate(seen(there, 2.2)).report.smoothing.lag_ms > 0


def test_a_touch_in_dispute_stays_where_it_is_on_the_new_surface(tracker, follower, shell):
    there = lying(tracker)
    before = follower.locate(seen(there, 1))
    surface = before.organ_mesh.vertices_mm
    end = surface[surface[:, 1].argmax()]  # far from where it is cut
    off = Touch(place_mm=tuple(end + [0, 30.0, 0]))
    disputed = follower.locate(seen(there, 1.1), evidence=[off, cut(shell)])
    assert disputed.report.evidence[0].rejected
    follower.locate(seen(there, 2))
    assert kind(follower.locate(seen(there, 2.1))) == "disputed"
    for n in range(3):  # there, as the answer has it
        follower.locate(seen(there, 2.2 + n / 10), evidence=[Touch(place_mm=tuple(end))])
    assert follower.locate(seen(there, 3)).quality == "good"


def test_where_a_cut_organ_was_lost_its_pieces_are_taken_together_now_and_then(tracker, shell):
    there, follower = lying(tracker), Follower(tracker, FollowerConfig())
    boxes_s = np.arange(5, 6, 0.1) + 0.05

    def boxes():
        return [follower.last_box_mm(int(at_s * S)) is not None for at_s in boxes_s]

    found = follower.locate(seen(there, 1))
    follower.lose()
    assert not any(boxes())  # a whole organ is one piece
    found = follower.locate(seen(there, 2), evidence=[cut(shell)])
    follower.lose()
    assert sum(boxes()) == len(boxes_s) / 2
    box_mm = next(
        box for at_s in boxes_s if (box := follower.last_box_mm(int(at_s * S))) is not None
    )
    np.testing.assert_array_equal(box_mm, found.organ_mesh.box_mm)
    follower.forget()
    assert not any(boxes())
