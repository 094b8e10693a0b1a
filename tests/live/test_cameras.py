"""Several cameras, and one that moves: which frames go together, and where each camera was."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_objects import ALL, ASIDE, BASE, MS, Led, Located, Tape, played, seen_at
from live_objects import STAMP_NS, small_estimate, small_setting
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import HERE, rigid
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.cameras import Cameras, camera_setup
from tumortrack.live.loop import Loop, LoopConfig
from tumortrack.live.poses import FilePoses, PoseBuffer
from tumortrack.live.values import PublishedFrame, SourceLost
from tumortrack.live.workers import SourceWorker


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
    (look,) = tracker.asked[1][1]
    np.testing.assert_allclose(look.camera_from_look, ASIDE, atol=1e-9)
    assert look.seen.stamp_ns == STAMP_NS + 40 * MS
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
    assert "camera 1: the source is frozen" in told[5].cameras
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
        raise InputError("no such topic")

    workers = [SourceWorker(lambda: Tape(*range(0, 90_000, 33))), SourceWorker(never)]
    cameras = Cameras(workers, [BASE, BASE @ ASIDE])
    loop = Loop(Located(), small_setting(), LoopConfig(region=ALL))
    with pytest.raises(InputError, match="no such topic"):
        loop.run(cameras, [], lambda _: None)
    cameras.close()


def test_results_of_a_camera_that_moves_are_in_the_fixed_frame_and_missing_poses_are_said():
    published = PublishedFrame("base", HERE, calibrated=True, moves=True)
    tracker = Located()
    told, _ = played([Tape(0, 33, 66, 99)], Led(STAMP_NS + 99 * MS), published, tracker=tracker)
    centers = np.array([one.center_mm("kidney") for one in told[:3]])
    np.testing.assert_allclose(centers[:, 0] - centers[0, 0], [0, 3.3, 6.6], atol=1e-6)
    assert told[0].published_frame.frame_id == "base"
    assert told[3].estimate is None
    assert told[3].reason == "where the camera was is unknown: no pose has come"
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
    with pytest.raises(NoEstimate, match=r"last pose is older than the frame by 0.03 s"):
        buffer.at(STAMP_NS + 150 * MS)
    with pytest.raises(NoEstimate, match=r"first pose is newer than the frame by 0.05 s"):
        buffer.at(STAMP_NS - 50 * MS)
    buffer.add(STAMP_NS + 300 * MS, screw[0])
    with pytest.raises(NoEstimate, match=r"0.18 s apart; allowed: 0.1 s"):
        buffer.at(STAMP_NS + 200 * MS)
    buffer.add(STAMP_NS - 10**9, screw[1])  # the clock was set back
    np.testing.assert_array_equal(buffer.at(STAMP_NS - 10**9), screw[1])
    with pytest.raises(NoEstimate, match="newer"):
        buffer.at(STAMP_NS - 2 * 10**9)


HEAD = "stamp_ns,frame_id,x_mm,y_mm,z_mm,qw,qx,qy,qz\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no rows"),
        ("stamp,x\n1,2\n", "column 'stamp'"),
        (HEAD, "has no rows"),
        (HEAD + "5,base,0,0,0,1,0,0,0\n5,base,0,0,0,1,0,0,0\n", "stamps must rise"),
        (HEAD + "5,base,0,0,0,1,1,0,0\n", "qw, qx, qy, qz must have length 1"),
        (HEAD + "5,base,0,0,0,nan,0,0,0\n", "must be finite"),
        (HEAD + "5,base,0,inf,0,1,0,0,0\n", "must be finite"),
        (HEAD + "5,base,0,0,0,1,0,0,0\n6,tool,0,0,0,1,0,0,0\n", "frame_id must be one"),
        (HEAD + "5,,0,0,0,1,0,0,0\n", "frame_id must be one"),
        (HEAD + "x,base,0,0,0,1,0,0,0\n", "line 2, column stamp_ns"),
        (HEAD + "5,base,0,0\n", "line 2"),
    ],
)
def test_tables_of_poses_are_refused_with_the_line(tmp_path, text, said):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        FilePoses(path)


def test_a_camera_on_a_tool_is_placed_by_its_calibration(tmp_path):
    tool, poses = tmp_path / "tool.json", tmp_path / "poses.csv"
    content = {"frame_id": "base", "unit": "mm", "tool_from_camera": ASIDE.tolist()}
    tool.write_text(json.dumps(content))
    poses.write_text(HEAD + f"{STAMP_NS},base,10,20,30,0,1,0,0\n")
    setup = camera_setup(["virtual:x"], None, f"file:{poses}", tool)
    tool_pose = rigid(np.diag([1.0, -1, -1]), np.array([10.0, 20, 30]))
    np.testing.assert_allclose(setup.poses.at(seen_at(0)), tool_pose @ ASIDE, atol=1e-9)
    assert setup.published.moves
    with pytest.raises(InputError, match="track --moving"):
        read_frames(tool)  # plans and fixed cameras
    content["frame_id"] = "other"
    tool.write_text(json.dumps(content))
    with pytest.raises(InputError, match="must be of the frame of these poses, 'base'"):
        camera_setup(["virtual:x"], None, f"file:{poses}", tool)
    content["robot_from_camera"] = content.pop("tool_from_camera")
    tool.write_text(json.dumps(content))
    with pytest.raises(InputError, match="tool_from_camera is of a camera"):
        camera_setup(["virtual:x"], None, f"file:{poses}", tool)


def test_options_that_do_not_go_together_are_refused(tmp_path):
    poses = tmp_path / "poses.json"
    rows = [BASE.tolist(), (BASE @ ASIDE).tolist()]
    poses.write_text(json.dumps({"unit": "mm", "frame_id": "base", "fixed_from_camera": rows}))
    for views, file, moving in (
        (("virtual:y",), None, ""),
        ((), poses, ""),
        (("virtual:x",), poses, ""),
        (("virtual:y",), poses, "file:z.csv"),
    ):
        with pytest.raises(InputError, match="--views needs --poses"):
            camera_setup(["virtual:x", *views], file, moving, None)
    with pytest.raises(InputError, match="2 poses for 3 views"):
        camera_setup([f"virtual:{n}" for n in "xyz"], poses, "", None)
    with pytest.raises(InputError, match="no kind 'tea'"):
        camera_setup(["virtual:x"], None, "tea:x", None)
