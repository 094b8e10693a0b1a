"""Several cameras, and one that moves: which frames go together, and where each camera was."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_objects import ASIDE, BASE, MS, Led, Located, Tape, played, seen_at
from live_objects import STAMP_NS, small_estimate
from refused import refused
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.evidence import Grasp
from tumortrack.core.geometry import IDENTITY, rigid
from tumortrack.live.cameras import camera_setup
from tumortrack.live.poses import FilePoses, PoseBuffer
from tumortrack.live.values import PublishedFrame, SourceLost


def test_frames_of_about_one_moment_go_together():
    tracker = Located()
    told, report = played(
        [Tape(0, 33, 66, 100), Tape(10, 40, 90, 119, of=5.0)], [BASE, BASE @ ASIDE], tracker=tracker
    )
    assert [one.cameras for one in told[:4]] == [
        "cameras 1, 2",
        "cameras 1, 2",
        "camera 1; camera 2: its frame is 0.02 s later",  # 24 ms: more than 20
        "cameras 1, 2",  # that frame of 90 ms
    ]
    assert [len(others) for _, others in tracker.asked[:4]] == [1, 1, 0, 1]
    (view,) = tracker.asked[1][1]
    np.testing.assert_allclose(view.camera_from_view, ASIDE, atol=1e-9)
    assert view.full_view.stamp_ns == STAMP_NS + 40 * MS
    assert [view.number for view in told[1].views] == [1, 2]
    assert told[1].estimate.report.cameras == (1, 2)
    assert report["cameras"]["1"] == 4
    assert report["cameras"]["2"] >= 3


def test_where_the_first_camera_ends_another_goes_on_in_the_same_frame():
    told, _ = played(
        [Tape(0, 33, SourceLost("unplugged")), Tape(0, 33, 66, 100, of=5.0)], [BASE, BASE @ ASIDE]
    )
    good = [one for one in told if one.estimate is not None]
    assert [one.stamp_ns - STAMP_NS for one in good] == [0, 33 * MS, 66 * MS, 100 * MS]
    assert "camera 1: " in good[-1].cameras
    assert good[-1].cameras.startswith("camera 2; ")
    assert good[-1].published_frame.frame_id == "base"
    # The stub puts the organ at one place before every camera.
    first, last = good[0].center_mm("kidney"), good[-1].center_mm("kidney")
    np.testing.assert_allclose(first, (BASE @ [4, -3, 130, 1])[:3], atol=1e-6)
    np.testing.assert_allclose(last, (BASE @ ASIDE @ [4, -3, 130, 1])[:3], atol=1e-6)


def test_a_camera_whose_image_is_frozen_is_named_and_the_others_go_on():
    class Frozen(Tape):
        def read(self, timeout_s):
            seen = super().read(timeout_s)
            still = replace(seen_at(0).content, stamp_ns=seen.stamp_ns)
            return replace(seen, content=still)

    every = range(0, 700, 100)
    told, _ = played([Frozen(*every), Tape(*every, of=5.0)], [BASE, BASE @ ASIDE])
    assert all(one.estimate is not None for one in told)
    assert told[1].cameras == "cameras 1, 2"
    assert "camera 1: " in told[5].cameras
    assert told[5].cameras.startswith("camera 2; ")


def test_no_camera_that_sees_it_is_no_estimate_and_each_says_why():
    def empty(*stamps):
        class Nothing(Tape):
            def read(self, timeout_s):
                seen = super().read(timeout_s)
                nothing = np.full_like(seen.content.depth_mm, np.nan)
                return replace(seen, content=replace(seen.content, depth_mm=nothing))

        return Nothing(*stamps)

    told, _ = played([empty(0), empty(0)], [BASE, BASE @ ASIDE])
    assert told[0].estimate is None
    assert "camera 1: " in told[0].reason
    assert "camera 2: " in told[0].reason


def test_a_source_that_can_never_work_ends_the_run():
    def never():
        raise InputError("topic 7")

    with refused(InputError, "topic 7"):
        played([Tape(*range(0, 90_000, 33)), never], [BASE, BASE @ ASIDE])


def test_results_of_a_camera_that_moves_are_in_the_fixed_frame_and_missing_poses_are_said():
    published = PublishedFrame("base", IDENTITY, calibrated=True, moves=True)
    tracker = Located()
    told, _ = played([Tape(0, 33, 66, 99)], Led(STAMP_NS + 99 * MS), published, tracker=tracker)
    centers = np.array([one.center_mm("kidney") for one in told[:3]])
    np.testing.assert_allclose(centers[:, 0] - centers[0, 0], [0, 3.3, 6.6], atol=1e-6)
    assert told[0].published_frame.frame_id == "base"
    assert told[3].estimate is None
    assert told[3].finding.kind == "no_pose"
    assert told[3].observation is None  # nobody knows where that would be
    # The next search starts where the organ was, seen from where the camera is now.
    last = tracker.asked[1][0]
    np.testing.assert_allclose(
        last.cloud.points_mm[:, 0], small_estimate().cloud.points_mm[:, 0] - 3.3, atol=1e-4
    )
    box_mm = small_estimate().meshes["kidney"].box_mm - [3.3, 0, 0]
    np.testing.assert_allclose(last.meshes["kidney"].box_mm, box_mm, atol=1e-6)


def test_poses_between_stamps_turn_at_a_constant_rate():
    buffer = PoseBuffer()
    screw = [
        rigid(Rotation.from_rotvec([0, 0.2 * n, 0]).as_matrix(), np.array([3.0 * n, 0, 1]))
        for n in range(4)
    ]
    for n, pose in enumerate(screw):
        buffer.add(STAMP_NS + 40 * n * MS, pose)
    for n in (0.0, 1.0, 1.25, 2.5):
        expected = rigid(Rotation.from_rotvec([0, 0.2 * n, 0]).as_matrix(), np.array([3 * n, 0, 1]))
        np.testing.assert_allclose(buffer.at(STAMP_NS + round(40 * n * MS)), expected, atol=1e-7)
    for ms, kind, seconds in ((150, "old_pose", 0.03), (-50, "new_pose", 0.05)):
        with pytest.raises(NoEstimate) as refused:
            buffer.at(STAMP_NS + ms * MS)
        finding = refused.value.finding
        assert (finding.kind, finding.values["seconds"]) == (kind, pytest.approx(seconds))
    buffer.add(STAMP_NS + 300 * MS, screw[0])
    with pytest.raises(NoEstimate) as refused:
        buffer.at(STAMP_NS + 200 * MS)
    assert refused.value.finding.values["seconds"] == pytest.approx(0.18)
    buffer.add(STAMP_NS - 10**9, screw[1])  # the clock was set back
    np.testing.assert_array_equal(buffer.at(STAMP_NS - 10**9), screw[1])
    with pytest.raises(NoEstimate):
        buffer.at(STAMP_NS - 2 * 10**9)


HEAD = "stamp_ns,frame_id,x_mm,y_mm,z_mm,qw,qx,qy,qz\n"


ROW = "5,base,0,0,0,1,0,0,0"


@pytest.mark.parametrize(
    "text",
    [
        "stamp,x\n1,2\n",
        f"{HEAD}{ROW}\n{ROW}\n",  # stamps must rise
        HEAD + "5,base,0,0,0,1,1,0,0\n",  # no unit quaternion
        HEAD + "5,base,0,0,0,nan,0,0,0\n",
        HEAD + "5,base,0,inf,0,1,0,0,0\n",
        f"{HEAD}{ROW}\n6,tool,0,0,0,1,0,0,0\n",  # two frames
        HEAD + "5,,0,0,0,1,0,0,0\n",
        f"{HEAD.strip()},contact\n{ROW},2\n",
        f"{HEAD.strip()},contact\n{ROW}\n",
    ],
)
def test_tables_of_poses_that_are_none_are_refused(tmp_path, text):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with refused(InputError, "poses.csv"):
        FilePoses(path)


def test_a_table_says_when_the_tip_touches(tmp_path):
    path = tmp_path / "tool.csv"
    path.write_text(f"{HEAD.strip()},contact\n{ROW},0\n9{ROW[1:]},1\n")
    poses = FilePoses(path)
    assert poses.touches == [(5, False), (9, True)]
    np.testing.assert_array_equal(poses.poses.at(7), np.eye(4))
    path.write_text(f"{HEAD}{ROW}\n")
    assert FilePoses(path).touches == []


def test_options_that_do_not_go_together_are_refused(tmp_path):
    poses = tmp_path / "poses.json"
    rows = [BASE.tolist(), (BASE @ ASIDE).tolist()]
    poses.write_text(json.dumps({"unit": "mm", "frame_id": "base", "fixed_from_camera": rows}))
    for sources, file, moving in (
        ("xy", None, ""),
        ("x", poses, ""),
        ("xx", poses, ""),
        ("xy", poses, "file:z.csv"),
        ("xyz", poses, ""),
        ("x", None, "tea:x"),
    ):
        with pytest.raises(InputError):
            camera_setup([f"virtual:{name}" for name in sources], file, moving, None)


class Holding:
    """A controller that holds something in every frame, at the frame's time."""

    ended = False

    def evidence(self, camera_from_published, stamp_ns):
        place_mm = tuple(camera_from_published[:3, 3].tolist())
        return (Grasp(point_ct=(1.0, 2.0, 3.0), place_mm=place_mm, stamp_ns=stamp_ns),)

    def act(self, result):
        return result

    def stop(self, why, words=""):
        self.ended = True

    def summary(self):
        return {}


def test_what_a_controller_holds_goes_into_each_frames_estimate_in_its_cameras_frame():
    tracker, controller = Located(), Holding()
    told, _ = played([Tape(0, 33, 66)], [BASE], tracker=tracker, controller=controller)
    held = [piece for _, evidence in tracker.asked for piece in evidence]
    assert [piece.stamp_ns for piece in held] == [one.stamp_ns for one in told[:3]]
    for piece in held:  # the origin of the published frame
        np.testing.assert_allclose(piece.place_mm, np.linalg.inv(BASE)[:3, 3])
    assert controller.ended  # stopped for good where tracking ends
