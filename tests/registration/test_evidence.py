"""Evidence beside the points: terms against finite differences, what they do to an answer, and what
contradicts it."""

from __future__ import annotations

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import trimesh

from elastic_objects import CENTER, RADII
from refused import refused
from stories import answered, refusal, tumortrack
from tumortrack.assessment.advice import Advisor
from tumortrack.core.errors import InputError, NoEstimate, NotThisOrgan
from tumortrack.core.evidence import (
    FreeSpace,
    Grasp,
    Landmark,
    Outline,
    Touch,
)
from tumortrack.core.report import Cause
from tumortrack.core.types import Mesh, SensorCloud
from tumortrack.io.evidence_files import evidence_json, read_evidence
from tumortrack.io.ply import write_cloud_ply
from tumortrack.registration.evidence import EvidenceTerms, TrackedEvidence, propagate
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.tracking.follower import Follower, FollowerConfig
from warp_objects import ANATOMY, method, nudged, placed, shape

NAMES = ANATOMY.names
TRUE = placed(share=0.3)
VERTICES = ANATOMY.organ.vertices_mm
NORMALS = (VERTICES - CENTER) / RADII**2
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
MOVED = TRUE.forward(VERTICES)
FACING = -((NORMALS @ TRUE.rotation.T) * MOVED).sum(1) / np.linalg.norm(MOVED, axis=1)
SEEN = MOVED[FACING > 0.3]
BEHIND = VERTICES[FACING < -0.4]
TUMOR = ANATOMY.tumors[0].vertices_mm


def at(point_ct):
    """Where the true organ has it."""
    return tuple(map(float, TRUE.forward(np.atleast_2d(point_ct))[0]))


def touches(count, noise_mm=0.3, seed=0):
    rng = np.random.default_rng(seed)
    chosen = BEHIND[rng.choice(len(BEHIND), count, replace=False)]
    return [Touch(place_mm=tuple(np.array(at(p)) + rng.normal(0, noise_mm, 3))) for p in chosen]


def every_kind():
    tumor = [at(p) for p in TUMOR[:: len(TUMOR) // 8]]
    inside = at(CENTER + [0.0, 2.0, 5.0])
    return [
        Touch(place_mm=at(BEHIND[0] + 2 * NORMALS[FACING < -0.4][0]), tip_mm=2.0),
        Touch(place_mm=at(TUMOR[3]), part="tumor_1", std_mm=0.5),
        Landmark(point_ct=CENTER + [5, 1, -20], place_mm=at(CENTER + [5, 1, -20]), std_mm=1.5),
        Outline(places_mm=tuple(tumor), part="tumor_1"),
        FreeSpace(places_mm=(inside, (0.0, 0.0, 20.0)), std_mm=2.0),
    ]


def test_terms_change_as_their_derivatives_say():
    terms = EvidenceTerms.from_evidence(every_kind(), NAMES)
    motion = placed(share=0.0)
    now, step = terms.at(motion), 1e-3
    assert len(now.residuals_mm) == 1 + 1 + 8 + 2 + 3 + (len(TUMOR[:: len(TUMOR) // 8]) - 8)
    for n in range(now.by_motion.shape[1]):
        change = np.zeros(now.by_motion.shape[1])
        change[n] = step
        ahead, behind = (terms.at(motion.changed(sign * change)) for sign in (1, -1))
        if 3 <= n < 6:  # a landmark's residual is in the organ's axes, which turn
            for sign, each in ((1, ahead), (-1, behind)):
                turned = motion.rotation.T @ motion.changed(sign * change).rotation
                each.residuals_mm[-3:] = turned @ each.residuals_mm[-3:]
        slopes = (ahead.residuals_mm - behind.residuals_mm) / (2 * step)
        near = np.isclose(slopes, now.by_motion[:, n], atol=0.03, rtol=0.03)
        assert near.mean() > 0.9  # but at the edges of the distance field's cells


def test_a_place_without_tissue_counts_inside_the_organ_alone():
    inside, outside = at(CENTER), (0.0, 0.0, 20.0)
    terms = EvidenceTerms.from_evidence(
        [FreeSpace(places_mm=(inside, outside), tip_mm=1.0)], NAMES
    ).at(TRUE)
    assert terms.residuals_mm[0] < -5
    assert terms.residuals_mm[1] == 0
    assert not terms.by_motion[1].any()
    assert terms.contradicting.tolist() == [0]


def at_all(points_ct):
    return TRUE.forward(points_ct)


def fitted(evidence):
    views = MultiViewCloud.from_points([SEEN], (), EvidenceTerms.from_evidence(evidence, NAMES))
    return method().register(views)


def this_way_round():
    marked = CENTER + [20.0, 0, 30], CENTER + [0, 12.0, -30]
    return [Landmark(point_ct=p, place_mm=at(p)) for p in marked]


def test_evidence_where_nothing_is_seen_brings_the_answer_nearer_and_makes_it_surer():
    outline = Outline(places_mm=tuple(map(at, TUMOR[::20])), part="tumor_1", std_mm=0.5)
    off_mm, std_mm = {}, {}
    for name, evidence in {"nothing": [], "touches": touches(12), "outline": [outline]}.items():
        motion = replace(fitted(evidence).motion, alternatives=())
        off_mm[name] = np.linalg.norm(motion.forward(VERTICES) - MOVED, axis=1).mean()
        std_mm[name] = motion.std_mm(BEHIND).mean()
    assert max(std_mm["touches"], std_mm["outline"]) < 0.95 * std_mm["nothing"]
    assert off_mm["touches"] < 0.9 * off_mm["nothing"]
    turned = fitted(this_way_round()).motion  # an ellipsoid fits as well after half a turn
    assert np.linalg.norm(turned.forward(VERTICES) - MOVED, axis=1).mean() < 3


def test_a_closed_structure_is_touched_and_outlined_as_a_part_is():
    ball = trimesh.creation.icosphere(3, 6.0)
    artery = Mesh(ball.vertices + BEHIND[len(BEHIND) // 2], ball.faces)
    open_one = Mesh(artery.vertices_mm, artery.faces[1:])
    anatomy = replace(ANATOMY, structures={"artery": artery, "sheet": open_one})
    assert tuple(anatomy.closed) == (*NAMES, "artery")
    rest = replace(shape(), anatomy_ct=anatomy)
    true = replace(TRUE, shape=rest)
    told = Outline(places_mm=tuple(map(at, artery.vertices_mm[::40])), part="artery", std_mm=0.5)
    terms = EvidenceTerms.from_evidence([told], tuple(anatomy.closed))
    assert np.abs(terms.at(true).residuals_mm).max() < 0.3
    fit = replace(method(), rest=rest).register(MultiViewCloud.from_points([SEEN], (), terms))
    off_mm = fit.motion.forward(artery.vertices_mm) - true.forward(artery.vertices_mm)
    assert np.linalg.norm(off_mm, axis=1).mean() < 2
    with refused(InputError, "sheet"):
        EvidenceTerms.from_evidence(
            [Touch(place_mm=at(CENTER), part="sheet")], tuple(anatomy.closed)
        )


@pytest.mark.parametrize(
    ("agree", "wrong", "decides"), [(4, 1, True), (8, 1, False), (9, 2, True), (10, 2, False)]
)
def test_many_that_agree_outvote_what_contradicts_them(tracker, agree, wrong, decides):
    away = np.array(at(BEHIND[0])) + [0, 0, 25.0]
    false = [Touch(place_mm=tuple(away + [3.0 * n, 0, 0])) for n in range(wrong)]
    cloud, right = SensorCloud(SEEN.astype(np.float32)), touches(agree)
    found = tracker.locate(cloud, grid=16, evidence=[*right, *false])
    told = found.report.evidence
    assert [each.rejected for each in told] == [False] * agree + [True] * wrong
    assert (found.finding is not None and found.finding.kind == "evidence") == decides
    if decides:
        assert found.finding.values["number"] > agree
    assert told[agree].off_mm == pytest.approx(25, abs=3)
    assert told[agree].information_gain == pytest.approx(0, abs=1e-9)
    assert told[agree].places_mm == (tuple(away),)
    assert all(0 < each.information_gain <= 1 for each in told[:agree])
    rest = tracker.locate(cloud, grid=16, evidence=right)
    apart = found.motion.forward(VERTICES) - rest.motion.forward(VERTICES)
    assert np.linalg.norm(apart, axis=1).max() < 0.5


def sides(motion):
    """What a camera sees of the organ, and the motion."""
    moved = motion.forward(VERTICES)
    facing = -((NORMALS @ motion.rotation.T) * moved).sum(1) / np.linalg.norm(moved, axis=1)
    return SensorCloud(moved[facing > 0.3].astype(np.float32))


def drifting(frames=6):
    """The organ slides by 3 mm a frame, turns a little, and bends."""
    for n in range(frames):
        turned = nudged(TRUE, [0, 0, 0], [0, 0, 0.01 * n])
        yield replace(
            turned,
            centre_mm=TRUE.centre_mm + [3.0 * n, -1.0 * n, 0.5 * n],
            coefficients=(1 + 0.1 * n) * TRUE.coefficients,
        )


def stamped(cloud, n):
    return replace(cloud, stamp_ns=1 + 33_000_000 * n)


def test_what_was_touched_once_counts_while_the_organ_moves(tracker):
    off_mm = {}
    for name, more in {"nothing": [], "touches": touches(12)}.items():
        evidence = [*this_way_round(), *more]
        follower, errors = Follower(tracker, FollowerConfig()), []
        for n, motion in enumerate(drifting()):
            new = evidence if n == 0 else ()
            found = follower.locate(stamped(sides(motion), n), evidence=new)
            errors.append(
                np.linalg.norm(found.motion.forward(BEHIND) - motion.forward(BEHIND), axis=1)
            )
            assert len(found.evidence) == len(evidence)
        off_mm[name] = np.mean(errors[1:])
        told = found.report.evidence
        assert all(each.before and not each.rejected for each in told)
        assert all(1.5 < each.std_mm < 3 for each in told)  # 0.1 of some 16 mm, and 1 or 2 mm
        by_now = np.array([said.places_mm[0] for said in told])
        went_mm = np.linalg.norm(by_now - [piece.places[0] for piece in evidence], axis=1)
        assert went_mm == pytest.approx(16, abs=5)
    assert off_mm["touches"] < 0.9 * off_mm["nothing"] < 3


def test_many_touches_of_another_place_are_named_whether_or_not_the_organ_is_found(tracker):
    cloud = stamped(sides(TRUE), 0)
    away = [Touch(place_mm=tuple(TRUE.centre_mm + [0, 0, -35.0]), std_mm=0.05)] * 60
    try:  # rounding decides which it is
        found = tracker.locate(cloud, grid=16, evidence=away)
        named = found.quality == "poor" and all(each.rejected for each in found.report.evidence)
    except NotThisOrgan as error:
        named = Cause.EVIDENCE in [likely.cause for likely in error.causes]
    assert named
    tracker.locate(cloud, grid=16)
    many = Outline(places_mm=(TRUE.centre_mm,) * 1002, part="")
    with refused(InputError, "1002", "1000"):
        tracker.locate(cloud, grid=16, evidence=[many])


@pytest.mark.parametrize(("away_s", "known"), [(5.0, 14), (70.0, 0)])
def test_what_was_touched_is_still_known_when_the_organ_is_seen_again(tracker, away_s, known):
    follower = Follower(tracker, FollowerConfig())
    evidence = [*this_way_round(), *touches(12)]
    before, *_, after = drifting()
    follower.locate(stamped(sides(before), 0), evidence=evidence)
    hand = SensorCloud(np.full((30, 3), 100.0), stamp_ns=int(1e9))
    with pytest.raises(NoEstimate):
        follower.locate(hand)
    follower.lose()
    cloud = replace(stamped(sides(after), 0), stamp_ns=int(away_s * 1e9))
    found = follower.locate(cloud)
    assert len(found.report.evidence) == known
    assert all(each.before for each in found.report.evidence)
    for each, piece in zip(found.report.evidence, evidence, strict=False):  # as the tissue did
        assert np.linalg.norm(np.subtract(each.places_mm, piece.places)) == pytest.approx(16, abs=5)
    follower.forget()
    again = replace(cloud, stamp_ns=cloud.stamp_ns + int(1e8))
    assert follower.locate(again).report.evidence == ()


def test_touched_places_are_carried_as_the_tissue_goes():
    after = list(drifting())[-1]
    landmark, held = (
        kind(point_ct=BEHIND[0], place_mm=at(BEHIND[0])) for kind in (Landmark, Grasp)
    )
    free = FreeSpace(places_mm=((0.0, 0.0, 20.0),))
    outline = Outline(places_mm=tuple(map(at, TUMOR[:4])), part="tumor_1")
    pieces = [Touch(place_mm=at(BEHIND[0])), landmark, held, free, outline]
    known, moved = propagate([TrackedEvidence(piece, TRUE) for piece in pieces], after)
    assert [each.piece for each in known] == [pieces[0], landmark, outline]
    assert [each.name for each in moved] == ["touch", "landmark", "outline"]
    there_mm = after.forward(BEHIND[:1])[0]
    assert np.allclose(moved[0].place_mm, there_mm, atol=0.05)
    assert moved[1].place_mm == moved[0].place_mm
    assert np.allclose(moved[2].places_mm, after.forward(TUMOR[:4]), atol=0.05)
    way_mm = np.linalg.norm(there_mm - at(BEHIND[0]))
    assert moved[0].std_mm == pytest.approx(np.hypot(1.0, 0.1 * way_mm), rel=0.01)
    unsure = TrackedEvidence(Touch(place_mm=at(BEHIND[0]), std_mm=6.0), TRUE)
    assert propagate([unsure], TRUE)[1][0].std_mm == pytest.approx(6.0)  # as sure as it was
    far = replace(TRUE, centre_mm=TRUE.centre_mm + [60.0, 0, 0])  # it now errs by 6 mm more
    assert propagate([unsure, TrackedEvidence(pieces[0], TRUE)], far) == ((), ())
    many = [
        TrackedEvidence(Touch(place_mm=at(BEHIND[0]), stamp_ns=n + 1), TRUE) for n in range(900)
    ]
    kept, newest = propagate(many, TRUE)
    assert [each.stamp_ns for each in newest] == list(range(701, 901))
    assert [each.piece.stamp_ns for each in kept] == list(range(701, 901))


def test_what_a_tool_holds_is_where_the_tool_is_until_it_slips(tracker):
    first = tracker.locate(stamped(sides(TRUE), 0), grid=16)
    tip_mm = BEHIND[np.linalg.norm(BEHIND - TUMOR.mean(0), axis=1).argmin()]
    errors = {}
    for kind in ("nothing", "held"):
        follower = Follower(tracker, FollowerConfig())
        follower.begin(first)
        for n, motion in enumerate(drifting()):
            place = tuple(motion.forward(tip_mm[None])[0])
            held = Grasp(point_ct=tuple(tip_mm), place_mm=place, point_std_mm=0.3, std_mm=0.3)
            new = [held] if kind == "held" else []
            found = follower.locate(stamped(sides(motion), n + 1), evidence=new)
            assert len(found.evidence) == len(new)
        errors[kind] = np.linalg.norm(found.motion.forward(tip_mm[None])[0] - place)
    assert errors["held"] < min(0.8 * errors["nothing"], 1.0)
    slipped = msgspec.structs.replace(held, place_mm=tuple(np.array(place) + [0, 0, -25.0]))
    found = follower.locate(stamped(sides(motion), n + 2), evidence=[slipped])
    assert found.evidence == ()
    assert found.report.evidence[0].rejected


@pytest.mark.parametrize(
    "make",
    [
        lambda: Touch(place_mm=(0.0, 0.0, 5000.0)),
        lambda: Touch(place_mm=(0.0, float("nan"), 100.0)),
        lambda: Outline(places_mm=(), part="kidney"),
        lambda: Outline(places_mm=np.ones((3, 2)), part="kidney"),
        lambda: Touch(place_mm=((0.0, 0.0, 100.0),)),
        lambda: Touch(place_mm="abc"),
        lambda: Touch(place_mm=(0.02, 0.01, 0.15)),  # metres
        lambda: Touch(place_mm=(0.0, 0.0, 100.0), tip_mm=-1.0),
        lambda: Touch(place_mm=(0.0, 0.0, 100.0), std_mm=0.0),
        lambda: EvidenceTerms.from_evidence(
            [Outline(places_mm=((0, 0, 100.0),), part="liver")], NAMES
        ),
    ],
)
def test_what_is_not_allowed_is_refused(make):
    with pytest.raises(InputError):
        make()


def test_the_touches_that_would_tell_most_tell_as_much_as_they_say():
    compliant = method().refine_compliance(fitted([]))
    motion = replace(compliant.motion, alternatives=())
    planned = Advisor(motion, 1).touches()
    stds_mm = [planned[0].std_mm, *(each.then_std_mm for each in planned)]
    assert np.all(np.diff(stds_mm) < 0)
    places_mm = np.array([each.place_mm for each in planned])
    distance_mm = np.linalg.norm(places_mm[:, None] - places_mm, axis=2)
    assert distance_mm[np.triu_indices(3, 1)].min() > 10
    how = {"std_mm": 1.0, "shared_std_mm": 1.0, "tool": "pointer"}
    touched = [Touch(place_mm=place, **how) for place in places_mm]
    views = replace(compliant.views, evidence=EvidenceTerms.from_evidence(touched, NAMES))
    terms = views.evidence.at(compliant.motion)
    precision = np.linalg.inv(compliant.motion.covariance)
    terms.add_to(precision, np.zeros(len(precision)))
    middle = compliant.motion.effects(compliant.motion.shape.middles_ct[[1]])[0]
    found = np.linalg.eigvalsh(middle @ np.linalg.inv(precision) @ middle.T)[-1] ** 0.5
    assert found == pytest.approx(stds_mm[-1], rel=0.02)


TABLE = """piece,frame,kind,part,x_mm,y_mm,z_mm,std_mm,tip_mm,x_ct_mm,y_ct_mm,z_ct_mm,stamp_ns
1,camera,touch,,1.5,2,150,0.8,1.5,,,,
2,camera,outline,tumor_1,3,4,140,,,,,,
2,camera,outline,tumor_1,5,4,139,,,,,,
3,camera,landmark,,20,3,133,,,-41,12.5,88,7
"""


def test_a_file_comes_back_a_table_says_the_same_and_what_is_older_than_the_pose_is_refused(
    tmp_path,
):
    held = Grasp(point_ct=CENTER, place_mm=at(CENTER), tool="gripper", stamp_ns=5)
    evidence = (*every_kind(), held)
    (tmp_path / "e.json").write_bytes(evidence_json(evidence))
    assert read_evidence(tmp_path / "e.json")[1] == evidence
    file = tmp_path / "e.csv"
    file.write_text(TABLE)
    assert read_evidence(file)[1] == (
        Touch(place_mm=(1.5, 2.0, 150.0), tip_mm=1.5, std_mm=0.8),
        Outline(places_mm=((3.0, 4.0, 140.0), (5.0, 4.0, 139.0)), part="tumor_1"),
        Landmark(point_ct=(-41.0, 12.5, 88.0), place_mm=(20.0, 3.0, 133.0), stamp_ns=7),
    )
    told = read_evidence(file)[1]
    file.write_bytes(b"\xef\xbb\xbf" + TABLE.encode())  # as spreadsheets write it
    assert read_evidence(file)[1] == told
    for named, given in (
        (("line 2", "'robot'"), TABLE.replace("1,camera", "1,robot")),
        (("line 2", "x_mm"), TABLE.replace("1.5,2", "far,2")),
        (("'smell'",), TABLE.replace("part,", "smell,")),
        (("line 4", "piece 2"), TABLE.replace("tumor_1,5", ",5")),
        (("z_mm",), TABLE.replace("y_mm,z_mm,std", "y_mm,point_std_mm,std")),
        ((), TABLE.splitlines()[0]),
        (("line 2",), TABLE.replace("touch", "smell")),
        (("line 3",), TABLE.replace("outline,tumor_1", "outline,")),
        (("std_mm", 99), TABLE.replace("140,,", "140,99,").replace("139,,", "139,99,")),
    ):
        file.write_text(given)
        with refused(InputError, file, *named):
            read_evidence(file)
    old = Touch(place_mm=(0.0, 0.0, 150.0), stamp_ns=5)  # older than the organ's last motion
    content = {**json.loads(evidence_json((old,))), "still_since_ns": 6}
    (tmp_path / "e.json").write_text(json.dumps(content))
    with refused(InputError, "touch 1", "5 ns", 6):
        read_evidence(tmp_path / "e.json")


def test_touches_alone_are_an_answer(slim_model, tmp_path):
    rng = np.random.default_rng(3)
    chosen = rng.choice(len(VERTICES), 40, replace=False)
    tips = MOVED[chosen] + 1.5 * NORMALS[chosen] @ TRUE.rotation.T
    evidence = [Touch(place_mm=tuple(p), tip_mm=1.5) for p in tips]
    file, out = tmp_path / "e.json", tmp_path / "out"
    file.write_bytes(evidence_json((*evidence, *this_way_round())))
    command = (
        "locate",
        slim_model,
        "-",
        "--out",
        out,
        "--grid",
        32,
        "--device",
        "cpu",
        "--evidence",
        file,
    )
    answered(tumortrack(*command))
    report = json.loads((out / "report.json").read_text())
    assert report["points"] == 40
    assert report["cloud_sha256"] is None
    told = report["evidence"]
    assert [each["name"] for each in told] == ["touch"] * 40 + ["landmark"] * 2
    assert not any(each["rejected"] for each in told)
    found_mm = np.array(report["parts"]["tumor_1"]["center_mm"])
    assert np.linalg.norm(found_mm - at_all(TUMOR).mean(0)) < 3
    file.write_bytes(evidence_json(tuple(evidence[:11])))
    line = refusal(tumortrack(*command, "--overwrite"))
    assert "12" in line
    assert "kidney" in line
    assert "--evidence" in refusal(tumortrack(*command[:-2], "--overwrite"))


def planes(count, noise_mm=0.3, **more):
    """The organ's border in parallel images across it, as ultrasound shows it."""
    rng = np.random.default_rng(4)
    along = MOVED[:, 0]
    ends = np.linspace(*np.quantile(along, (0.05, 0.95)), count)
    near = (np.flatnonzero(np.abs(along - end) < 1.5) for end in ends)
    return [
        Outline(places_mm=tuple(map(tuple, MOVED[mine] + rng.normal(0, noise_mm, (len(mine), 3)))),
                part="kidney", **more)
        for mine in near
    ]  # fmt: skip


NOTHING = SensorCloud(np.zeros((0, 3)))


def test_outlines_alone_are_an_answer_and_their_stated_error_counts(tracker):
    stds = {}
    for std_mm, shared_mm in ((0.3, 0.0), (3.0, 0.0), (0.3, 3.0)):
        told = planes(12, std_mm=std_mm, shared_std_mm=shared_mm, tool="probe")
        found = tracker.locate(NOTHING, grid=16, evidence=[*told, *this_way_round()])
        tumor = found.report.parts["tumor_1"]
        assert np.linalg.norm(np.array(tumor.center_mm) - at_all(TUMOR).mean(0)) < 2
        assert found.report.motion.depth_share == 0  # no camera
        stds[std_mm, shared_mm] = tumor.center_std_mm
    assert stds[3.0, 0.0] > 1.2 * stds[0.3, 0.0]
    assert stds[0.3, 3.0] > 2 * stds[0.3, 0.0]


def shifted(pieces, by_mm):
    return [each.at(np.array(each.places) + by_mm, each.std_mm) for each in pieces]


def test_in_a_frame_of_its_own_evidence_has_its_answer_there(tracker, slim_model, tmp_path):
    away_mm, told = np.array([400.0, -250.0, -300.0]), [*planes(12), *this_way_round()]
    here = tracker.locate(NOTHING, grid=16, evidence=told)
    there = tracker.locate(NOTHING, grid=16, evidence=shifted(told, away_mm), frame="tracker")
    for place in ("center_mm", "box_mm"):
        a, b = (np.array(getattr(f.report.parts["tumor_1"], place)) for f in (here, there))
        np.testing.assert_allclose(b - a, np.broadcast_to(away_mm, a.shape), atol=0.3)
    moved = there.motion.forward(VERTICES) - here.motion.forward(VERTICES)
    np.testing.assert_allclose(moved, np.tile(away_mm, (len(VERTICES), 1)), atol=0.5)
    off_mm = there.meshes["kidney"].vertices_mm - there.motion.forward(VERTICES)
    assert np.abs(off_mm).max() < 0.1
    for a, b in zip(there.report.evidence, shifted(told, away_mm), strict=True):
        np.testing.assert_allclose(a.places_mm, b.places, atol=1e-6)
    with refused(InputError):
        tracker.locate(SensorCloud(SEEN), grid=16, evidence=told, frame="tracker")
    file, out = tmp_path / "e.json", tmp_path / "out"
    content = json.loads(evidence_json(tuple(shifted(told, away_mm))))
    file.write_text(json.dumps({**content, "frame": "tracker"}))
    options = "--grid", 32, "--device", "cpu", "--evidence", file
    answered(tumortrack("locate", slim_model, "-", "--out", out, *options))
    for name in ("report.json", "manifest.json"):
        assert json.loads((out / name).read_text())["frame"] == "tracker"


def test_one_wrong_plane_of_many_is_named_and_moves_nothing(tracker):
    told = [*planes(12), *this_way_round()]
    right = tracker.locate(NOTHING, grid=16, evidence=told)
    told[4:5] = shifted(told[4:5], [0, 0, 22.0])
    found = tracker.locate(NOTHING, grid=16, evidence=told)
    assert [n for n, each in enumerate(found.report.evidence) if each.rejected] == [4]
    assert found.report.evidence[4].off_mm > 10
    away_mm = found.motion.forward(VERTICES) - right.motion.forward(VERTICES)
    assert np.linalg.norm(away_mm, axis=1).mean() < 1.0


def test_what_is_as_likely_the_other_way_round_is_said_with_its_place(tracker):
    """Nothing tells which way round an ellipsoid lies."""
    found = tracker.locate(NOTHING, grid=16, evidence=planes(12))
    others, tumor = found.report.fit_cost.others, np.array(found.report.parts["tumor_1"].center_mm)
    places = [tumor, *(np.array(each.center_mm["tumor_1"]) for each in others)]
    assert min(np.linalg.norm(place - at_all(TUMOR).mean(0)) for place in places) < 3
    assert max(each.turn_degrees for each in others) > 170
    assert 0.05 < sum(each.share for each in others) < 1
    assert found.quality == "poor"


def test_the_command_takes_a_file_and_says_what_is_wrong_with_it(slim_model, tmp_path):
    write_cloud_ply(tmp_path / "cloud.ply", SEEN.astype(np.float32))
    file, out = tmp_path / "e.json", tmp_path / "out"
    command = (
        "locate",
        slim_model,
        tmp_path / "cloud.ply",
        "--out",
        out,
        "--grid",
        32,
        "--device",
        "cpu",
    )
    content = json.loads(evidence_json((*touches(6), *this_way_round())))
    first = content["evidence"][0]
    wrong = {
        "'robot'": {"frame": "robot"},
        "'m'": {"unit": "m"},
        "e.json": {"evidence": [{"kind": "smell", "place_mm": [0, 0, 1]}]},
        "vessel": {"evidence": [{**first, "part": "vessel"}]},
    }
    for named, changed in wrong.items():
        file.write_text(json.dumps(content | changed))
        assert named in refusal(tumortrack(*command, "--evidence", file))
        assert not out.exists()
    file.write_text(json.dumps(content))
    advise = "--overwrite", "--evidence", file, "--advise"
    assert "cyst" in refusal(tumortrack(*command, *advise, "cyst"))
    said = answered(tumortrack(*command, *advise, "kidney"))
    assert "touch 6" in said
    report = json.loads((out / "report.json").read_text())
    told = report["assessment"].get("next_evidence", [])
    assert {each["part"] for each in told} <= {"kidney"}
    assert [each["name"] for each in report["evidence"]] == ["touch"] * 6 + ["landmark"] * 2
    assert len(report["evidence_sha256"]) == 64
    away = [{**first, "place_mm": [0.0, 0.0, 400.0]}]
    file.write_text(json.dumps(content | {"evidence": away}))
    assert "touch 1" in answered(tumortrack(*command, "--evidence", file, "--overwrite"))
