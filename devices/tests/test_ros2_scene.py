"""What ROS 2's users expect beside topics: frames on tf, /diagnostics, MoveIt's scene and
trajectories, and a package for their workspace."""

from __future__ import annotations

import io
import json
import os
import signal
import struct
import sys
import xml.etree.ElementTree as ET
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tyro
from PIL import Image

import clients
import needs
import tumortrack
from clock import PATIENCE_S, Clock, until
from live_objects import PARTS, ball, empty_update, small_setting, small_update
from refused import refused
from reports import NOWHERE, reporting
from ros2_objects import RCLPY, own_graph, peer, process
from tumortrack.cli.track import Track
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Mesh
from tumortrack.live.spec import SINKS
from tumortrack.live.values import PublishedFrame, TrackingResult
from tumortrack_devices.ros.bus import open_bus
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import ResultMessages
from tumortrack_devices.ros.sensors import COMPRESSED, image_of
from tumortrack_devices.ros.tf import TRANSFORMS, pose_of
from tumortrack_devices.sinks.moveit import SCENE, coarser, widened_hull
from tumortrack_devices.sinks.ros import ACKNOWLEDGE, ASKED

MESSAGES = Messages()
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
PLACED = PublishedFrame("table", rigid(QUARTER, np.array([10.0, 20, 30])), calibrated=True)
PACKAGE = Path(__file__).parents[1] / "integrations" / "ros2" / "tumortrack_ros"


def sent(results: ResultMessages, update: TrackingResult) -> dict:
    return {one.suffix: one.message for one in results.messages(update)}


def estimate_with(update: TrackingResult, meshes: dict[str, Mesh], **report: object) -> Estimate:
    known = update.estimate
    assert known is not None
    return reporting(replace(known, meshes={**known.meshes, **meshes}), **report)


def test_each_part_has_a_frame_turned_as_the_organ_is():
    update = small_update(frames=PLACED)
    turned = rigid(np.diag([1.0, -1, -1]), np.zeros(3))
    motion = {**NOWHERE, "camera_from_ct": turned.tolist()}
    known = estimate_with(update, {"artery": ball((1, 2, 130), 3)}, motion=motion)
    vessel = {"vessel": ball((0.0, 0.0, 125.0), 3.0)}
    update = replace(update, estimate=replace(known, structures=vessel))
    out = sent(ResultMessages(MESSAGES, small_setting()), update)["meshes"].markers
    assert [one.ns for one in out] == [*PARTS, "artery", "vessel", "quality"]
    frames = sent(ResultMessages(MESSAGES, small_setting(), namespace="/or_2"), update)["/tf"]
    assert [one.child_frame_id for one in frames.transforms] == [
        f"or_2/{name}" for name in (*PARTS, "artery")
    ]
    for one, name in zip(frames.transforms, (*PARTS, "artery"), strict=True):
        expected = rigid(QUARTER @ turned[:3, :3], update.center_mm(name))
        np.testing.assert_allclose(pose_of(one), expected, atol=1e-9)
        assert one.header.frame_id == "table"


def test_tf_is_silent_where_the_estimate_is_not_good():
    results = ResultMessages(MESSAGES, small_setting())
    poor = replace(small_update(), quality="poor", warning="one side alone is seen")
    assert [len(sent(results, one)["/tf"].transforms) for one in (poor, empty_update())] == [0, 0]


def test_diagnostics_come_each_second_and_at_once_where_the_level_changes(
    monkeypatch,
):
    monkeypatch.setattr("tumortrack_devices.network.time", Clock())
    results = ResultMessages(MESSAGES, small_setting())
    updates = [small_update(0), small_update(1), empty_update(2), empty_update(3), small_update(4)]
    came = [sent(results, one).get("/diagnostics") for one in updates]
    assert [None if one is None else one.status[0].level for one in came] == [0, None, 2, None, 0]
    dropped = replace(small_update(5), dropped=7)
    said = sent(results, dropped)["diagnostics"].status[0]
    values = {one.key: one.value for one in said.values}
    assert (values["dropped"], values["quality"]) == ("7", "good")
    assert float(values["rate_hz"]) > 0


# --- compressedDepth


def packed(values: np.ndarray, kind: str, a: float = 0.0, b: float = 0.0) -> object:
    """As image_transport's plugin packs it."""
    png = io.BytesIO()
    Image.fromarray(values).save(png, format="PNG")
    data = np.frombuffer(struct.pack("<i2f", 1, a, b) + png.getvalue(), np.uint8)
    return MESSAGES.make(COMPRESSED, header=MESSAGES.header(5, "arm"), format=kind, data=data)


def test_packed_depths_are_those_that_were_packed():
    steps = np.array([[0, 120, 65535], [7, 8, 9]], np.uint16)
    for kind in ("16UC1; compressedDepth png", "16UC1; compressedDepth"):
        image = image_of(packed(steps, kind), MESSAGES)
        assert (image.encoding, image.height, image.width) == ("16UC1", 2, 3)
        assert np.array_equal(image.data.view(np.uint16).reshape(2, 3), steps)
        assert image.header.frame_id == "arm"
    # The plugin's numbers for a far limit of 10 m and a quantisation of 100 (a = 100 * 101).
    a, b = 100 * 101.0, 1 - 100 * 101.0 / 10
    metres = np.array([[0.2, 0.5, 2.0]])
    image = image_of(packed((a / metres + b).astype(np.uint16), "32FC1; compressedDepth png",
                            a, b), MESSAGES)  # fmt: skip
    np.testing.assert_allclose(image.data.view(np.float32), metres[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("kind", "cut"), [("bgr8; jpeg compressed bgr8", 0), ("16UC1; compressedDepth rvl", 0),
                      ("16UC1; compressedDepth png", 20), ("16UC1; compressedDepth png", 70)]
)  # fmt: skip
def test_other_packings_and_damaged_ones_are_refused(kind, cut):
    message = packed(np.ones((20, 30), np.uint16), kind)
    message.data = message.data[: cut or None]
    with pytest.raises(InputError):
        image_of(message, MESSAGES)


# --- MoveIt


def test_a_margin_holds_all_that_is_so_near_and_little_else():
    tumor = ball((14.0, -3.0, 120.0), 6.0)
    wide = widened_hull(tumor, 5.0)
    normals = np.cross(*(wide.vertices_mm[wide.faces[:, n]] - wide.vertices_mm[wide.faces[:, 0]]
                         for n in (1, 2)))  # fmt: skip
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = np.einsum("ij,ij->i", normals, wide.vertices_mm[wide.faces[:, 0]])
    # Every plane of the hull is at least the margin beyond every point of the tumor.
    beyond_mm = heights - (tumor.vertices_mm @ normals.T).max(0)
    assert beyond_mm.min() >= 5 - 1e-6
    assert beyond_mm.max() < 5.6
    assert 4 / 3 * np.pi * 10.9**3 < wide.volume_mm3 < 4 / 3 * np.pi * 11.6**3


def test_a_coarser_surface_stays_near_and_keeps_its_holes():
    fine = Mesh(*_disc(60))
    few = coarser(fine, 4.0)
    assert len(few.faces) < len(fine.faces) / 5
    assert np.abs(few.vertices_mm[:, 2]).max() == 0
    corners = few.vertices_mm[few.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    assert area > 0
    assert np.ptp(few.vertices_mm[:, 0]) == pytest.approx(60, abs=4)


def _disc(n: int) -> tuple[np.ndarray, np.ndarray]:
    """An open sheet of n x n squares of 1 mm."""
    rows, columns = np.mgrid[: n + 1, : n + 1]
    vertices = np.stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()], axis=1).astype(float)
    first = (rows[:-1, :-1] * (n + 1) + columns[:-1, :-1]).ravel()
    squares = first[:, None] + np.array([0, 1, n + 2, 0, n + 2, n + 1])
    return vertices, squares.reshape(-1, 3)


def test_the_scene_s_options_are_checked():
    assert SINKS.parse("moveit").topic == "/planning_scene"
    with refused(InputError, "margin_mm"):
        SINKS.parse("moveit:/planning_scene?margin_mm=-1")
    with refused(InputError, "scene"):
        SINKS.parse("moveit:scene")


def test_obstacles_arrive_of_good_estimates_and_cameras_are_kept_for_latecomers():
    needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")
    setting = replace(small_setting(), published_frame=PLACED)
    good = small_update(frames=PLACED)
    with own_graph():
        bus = open_bus("dds")
        heard = bus.subscriber("/scene", SCENE)
        with pytest.raises(InputError):  # whose frame MoveIt does not know
            SINKS.parse("moveit:/scene").open(replace(setting, published_frame=PublishedFrame()))
        scene = SINKS.parse("moveit:/scene?margin_mm=5&hz=0").open(setting)
        sink = SINKS.parse("ros2:/theatre?camera_tf=true").open(setting)
        try:
            sink.publish(good)
            late = bus.subscriber("/tf_static", TRANSFORMS, latched=True)

            def came() -> list:
                scene.publish(replace(good, quality="poor", warning="seen from one side"))
                scene.publish(good)
                return heard.take()

            said = MESSAGES.from_bytes(until(came)[-1], SCENE)
            (camera,) = MESSAGES.from_bytes(until(late.take)[-1], TRANSFORMS).transforms
            scene.publish(empty_update())
            scene.close()
            later = [MESSAGES.from_bytes(raw, SCENE) for raw in heard.take()]
        finally:
            for one in (scene, sink, bus):
                one.close()
    assert said.is_diff
    assert said.robot_state.is_diff
    objects = {one.id: one for one in said.world.collision_objects}
    names = {f"tumortrack/{name}" for name in PARTS}
    assert objects.keys() == names | {f"{name}/margin" for name in names if "tumor_" in name}
    for one in (said, *later):  # nothing is taken away
        assert {each.operation for each in one.world.collision_objects} == {0}  # ADD
    for name in PARTS:
        (mesh,) = objects[f"tumortrack/{name}"].meshes
        points_mm = 1000 * np.array([[p.x, p.y, p.z] for p in mesh.vertices])
        corners = np.array([one.vertex_indices for one in mesh.triangles])
        expected = coarser(good.transformed.meshes[name], 3.0)
        np.testing.assert_allclose(points_mm, expected.vertices_mm, atol=1e-9)
        assert np.array_equal(corners, expected.faces)
        assert objects[f"tumortrack/{name}"].header.frame_id == "table"
    assert (camera.header.frame_id, camera.child_frame_id) == ("table", "camera")
    np.testing.assert_allclose(pose_of(camera), PLACED.published_from_camera, atol=1e-9)


# --- the package for a ROS 2 workspace; its launch file and build need more of ROS, and are not run


@pytest.fixture
def options(monkeypatch):
    monkeypatch.syspath_prepend(str(PACKAGE))
    from tumortrack_ros import options

    yield options
    for name in [name for name in sys.modules if name.startswith("tumortrack_ros")]:
        sys.modules.pop(name)


def test_parameters_are_options_of_track_and_have_their_defaults(options):
    asked = {"model": "MODEL", "source": "ros2:/depth", "range": "100 400", "whole": True}
    asked |= {"box": "-1 -2 3 4 5 6", "give_up": 7.0, "sinks": ["viewer", "moveit"]}
    program, name, *arguments = options.command(asked)
    assert (program, name) == ("tumortrack", "track")
    parsed = tyro.cli(Track, args=arguments)
    assert (parsed.source, parsed.sinks) == ("ros2:/depth", ("viewer", "moveit"))
    assert (parsed.range, parsed.box) == ((100, 400), (-1, -2, 3, 4, 5, 6))
    assert (parsed.whole, parsed.give_up) == (True, 7)
    tools = options.command({"model": "M", "source": "s", "tool": ["", "a=file:A.csv", "b=ur:1"]})
    assert tyro.cli(Track, args=tools[2:]).tool == ("a=file:A.csv", "b=ur:1")
    plain = tyro.cli(Track, args=options.command({"model": "M", "source": "s"})[2:])
    for name, option in options.OPTIONS.items():
        if name not in ("executable", "model", "source", "sinks", "tool"):
            assert (getattr(plain, name) or "") == (option.default or ""), name
    with refused(ValueError, "source"):
        options.command({"model": "MODEL"})


def node_command(**parameters: object) -> tuple[str, ...]:
    """That runs the node."""
    begin = "from tumortrack_ros.track_node import main; main()"
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    return sys.executable, "-c", begin, "--ros-args", *given


def test_a_parameter_that_tracking_refuses_is_set_back_and_it_goes_on(tmp_path):
    """The node in a real ROS 2, and programs that call its service, and set its parameters as
    `ros2 param` does."""
    started, end = tmp_path / "started", tmp_path / "end"
    program = tmp_path / "tumortrack"
    over = f"while [ ! -e {end} ]; do sleep 0.1; done; exit 7"  # the node ends with it, so not yet
    cases = f"case $* in *nonsense*) exit 2;; *over*) {over};; esac"
    program.write_text(f'#!/bin/sh\necho "$*" >> {started}\n{cases}\nexec sleep 99\n')
    program.chmod(0o755)
    command = node_command(executable=program, model="M", source="ros2:/depth")
    with own_graph():
        environment = clients.environment("ros-jazzy-rclpy")
        environment["PYTHONPATH"] += f"{os.pathsep}{PACKAGE}"
        with process(*command, environment=environment) as node, closing(open_bus("dds")) as bus:
            topic, kind = ACKNOWLEDGE
            acknowledged = bus.subscriber(f"/tumortrack/{topic}", kind)
            with peer("ask", "acknowledge", 2, by=RCLPY) as other:  # as the sink would hear it
                calls = [json.loads(other.line())["successful"] for _ in range(2)]
                bus.wait(PATIENCE_S)
            assert calls[-1]
            assert acknowledged.take()
            with peer("set", "stale=-5.0", "moving=nonsense", by=RCLPY) as other:
                refused, nonsense, back = (json.loads(other.line()) for _ in range(3))
            until(lambda: started.read_text().count("\n") == 3, "the former values")
            with peer("set", "moving=over", by=RCLPY) as other:
                assert json.loads(other.line())["successful"]
            end.touch()
            assert node.ended() == 7
    assert not refused["successful"]
    assert "stale" in refused["reason"]
    assert nonsense["successful"]  # only the command itself knows
    assert (back["moving"], back["stale"]) == ("", 0.5)
    said = [line.partition("--moving ")[2] for line in started.read_text().splitlines()]
    assert [words.split()[:1] for words in said] == [[], ["nonsense"], [], ["over"]]


def test_the_node_is_one_whose_life_others_manage(tmp_path):
    """By a lifecycle client of the real rclpy: it tracks while it is active, and refuses to change
    what it is about."""
    started = tmp_path / "started"
    program = tmp_path / "tumortrack"
    ended = "trap 'echo ended >> {0}; exit 0' INT; while :; do sleep 0.1; done"
    program.write_text(f'#!/bin/sh\necho "$*" >> {started}\n{ended.format(started)}\n')
    program.chmod(0o755)
    command = node_command(executable=program, source="ros2:/depth", autostart="false")

    def told(*words: str) -> list[dict]:
        with peer(*words, by=RCLPY) as other:
            count = int(words[2]) if words[0] == "ask" else len(words) - (words[0] == "set")
            lines = [json.loads(other.line()) for _ in range(count)]
            assert other.ended() == 0
            return lines

    with own_graph():
        environment = clients.environment("ros-jazzy-rclpy")
        environment["PYTHONPATH"] += f"{os.pathsep}{PACKAGE}"
        with process(*command, environment=environment) as node:
            first, *early = told("change", "configure", "activate")
            assert "tumortrack" in first["nodes"]
            assert [(one["done"], one["state"]) for one in early] == 2 * [(False, "unconfigured")]
            assert told("set", "model=M")[0]["successful"]
            _, *made = told("change", "configure", "activate")
            assert [one["state"] for one in made] == ["inactive", "active"]
            until(started.exists, "tracking")
            answers = told(
                "set", "model=other", "stale=-5", "stale=nan", "side=up", "smoothing=0.2"
            )
            assert [one["successful"] for one in answers] == [False] * 4 + [True]
            named = ("model", "stale", "stale", "side")
            assert all(name in one["reason"] for name, one in zip(named, answers, strict=False))
            until(lambda: started.read_text().count("--rescan") == 2, "tracking with the new value")
            assert not told("ask", "halt", "1")[0]["successful"]  # no arms: nobody listens
            with closing(open_bus("dds")) as bus:
                heard = bus.subscriber("/tumortrack/forget", ASKED["forget"])
                asked = told("ask", "forget", "4")
                bus.wait(PATIENCE_S)
                assert asked[-1]["successful"]
                assert heard.take()
            with peer("change", "1", "deactivate", "cleanup", by=RCLPY) as other:
                _, *made = (json.loads(other.line()) for _ in range(3))
            assert [one["state"] for one in made] == ["inactive", "unconfigured"]
            assert node.running()
            *runs, last = started.read_text().splitlines()
            assert last == "ended"
            assert "--smoothing 0.2" in runs[-1]
            assert told("set", "model=other")[0]["successful"]
            assert told("change", "shutdown")[1]["state"] == "finalized"
            node.signal(signal.SIGINT)
            assert node.ended() == 0


def test_the_package_names_this_version():
    about = ET.parse(PACKAGE / "package.xml").getroot()
    assert about.findtext("version") == tumortrack.__version__
    assert f'version="{tumortrack.__version__}"' in (PACKAGE / "setup.py").read_text()


def test_a_restart_writes_another_report(options, tmp_path):
    asked = {"model": "M", "source": "s", "report": str(tmp_path / "r.json")}
    for name in ("r.json", "r-2.json", "r-3.json"):
        plain = tyro.cli(Track, args=options.command(asked)[2:])
        assert plain.report == tmp_path / name
        (tmp_path / name).write_text("{}")
