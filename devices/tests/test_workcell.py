"""What arms do, on every sink: messages, recordings, OpenIGTLink."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clock import until
from igtl_objects import IgtlStatus, hear_all, status_by_the_book
from live_objects import small_setting, small_update
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.live.values import RigidShape, SinkContext, TrackingResult
from tumortrack_devices.igtl.message import unpack_transform
from tumortrack_devices.ros.messages import Messages, stamp_of
from tumortrack_devices.ros.results import ResultMessages
from tumortrack_devices.ros.sensors import cloud_of
from tumortrack_devices.ros.tf import pose_of
from tumortrack_devices.sinks.openigtlink import OpenIgtLinkSinkConfig
from workcell_objects import CUT, REASON, TABLE, virtual, with_arms, workcell, working

HUMBLE = Messages("humble")
NAMES = [shape.name for shape in workcell().shapes]


def sent(update: TrackingResult, results: ResultMessages | None = None) -> dict:
    results = results or ResultMessages(HUMBLE, with_arms())
    return {out.suffix: out.message for out in results.messages(update)}


def less(update: TrackingResult, *names: str) -> TrackingResult:
    """Without these shapes and lines."""
    cell = update.control
    assert cell is not None
    shapes = tuple(shape for shape in cell.shapes if shape.name not in names)
    lines = tuple(line for line in cell.lines if line.name not in names)
    return replace(update, control=replace(cell, shapes=shapes, lines=lines))


def assert_drawn(links: list, tf: object, shapes: tuple[RigidShape, ...]) -> None:
    """As RViz does it, a marker's pose in the frame of its header, and that in the table's: each
    corner of each triangle is where the arms have it."""
    frames = {one.child_frame_id: one for one in tf.transforms}
    for marker, shape in zip(links, shapes, strict=True):
        place = frames[marker.header.frame_id]
        assert place.header.frame_id == "table"
        p, q = marker.pose.position, marker.pose.orientation
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        shown = pose_of(place) @ rigid(turn, np.array([p.x, p.y, p.z]) * 1000)
        corners_mm = transform_points(shown, np.vstack(list(marker.points)) * 1000)
        corners_in_shape = shape.mesh.vertices_mm[shape.mesh.faces.ravel()]
        expected = transform_points(shape.published_from_shape, corners_in_shape)
        np.testing.assert_allclose(corners_mm, expected, atol=1e-6)


# ROS


def test_joints_and_markers_say_where_everything_stands():
    update = working(3, 0.3)
    out, cell = sent(update), update.control
    joints = out["joint_states"]
    assert dict(zip(joints.name, joints.position, strict=True)) == cell.joints_rad
    assert (stamp_of(joints.header), joints.header.frame_id) == (update.stamp_ns, "table")

    markers = {m.ns: m for m in out["workcell"].markers}
    assert list(markers) == ["cut/1", "cut/2", "state"]
    assert {stamp_of(m.header) for m in markers.values()} == {update.stamp_ns}
    assert all(m.action == m.ADD and m.lifetime.sec > 0 for m in markers.values())
    first, *links = out["links"].markers
    assert first.action == first.DELETEALL
    assert [m.ns for m in links] == NAMES
    for shape, marker in zip(cell.shapes, links, strict=True):
        assert marker.type == marker.TRIANGLE_LIST
        assert (marker.color.r, marker.color.a) == (shape.colour[0] / 255, 1.0)
        assert (marker.frame_locked, marker.lifetime.sec) == (True, 0)  # until it is replaced
    assert_drawn(links, out["/tf"], cell.shapes)
    # Later transforms carry what was drawn before along.
    results = ResultMessages(HUMBLE, with_arms())
    links = sent(update, results)["links"].markers[1:]
    way = rigid(Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([5.0, -70.0, 30.0]))
    moved = tuple(
        replace(shape, published_from_shape=way @ shape.published_from_shape)
        for shape in cell.shapes
    )
    out = sent(replace(working(4), control=replace(cell, shapes=moved)), results)
    assert "links" not in out
    assert_drawn(links, out["/tf"], moved)
    assert {stamp_of(one.header) for one in out["/tf"].transforms} == {working(4).stamp_ns}
    cut = markers["cut/1"]
    np.testing.assert_allclose(np.vstack(list(cut.points)) * 1000, cell.lines[0].points_mm)
    assert (cut.type, cut.scale.x) == (cut.LINE_STRIP, 0.002)
    assert [cut.color.r, cut.color.g, cut.color.b] == pytest.approx(np.array(CUT) / 255)
    text = markers["state"]
    assert (text.text, text.type) == ("sweep 1", text.TEXT_VIEW_FACING)
    everything = np.concatenate(
        [transform_points(s.published_from_shape, s.mesh.vertices_mm) for s in cell.shapes]
    )
    np.testing.assert_allclose(cell.box_mm, [everything.min(0), everything.max(0)], atol=1e-9)
    place, middle = text.pose.position, everything.min(0) / 2 + everything.max(0) / 2
    assert [place.x * 1000, place.y * 1000] == pytest.approx(middle[:2])
    assert place.z * 1000 == pytest.approx(everything[:, 2].max())


def test_arms_are_told_of_without_an_estimate_and_why_they_stand():
    results = ResultMessages(HUMBLE, with_arms())
    out = sent(virtual(halted="the tumor moved by 6 mm"), results)
    assert len(out["workcell"].markers) == 3
    assert len(out["links"].markers) == 1 + len(NAMES)
    assert [m.action for m in out["meshes"].markers] == [3]  # DELETEALL: no estimate
    first, *more = out["workcell"].markers[-1].text.splitlines()
    below = sent(working())["workcell"].markers[-1].pose.position.z
    below -= out["workcell"].markers[-1].pose.position.z  # its first line is at the same height
    assert below == pytest.approx((0.025 + 0.012) / 2 * len(more))
    assert (first, " ".join(more)) == (
        "sweep 1, halted: the tumor moved by 6 mm", f"none, no estimate: {REASON}"
    )  # fmt: skip
    estimate, arms = out["diagnostics"].status
    assert (estimate.level, arms.level, arms.name) == (2, 1, "tumortrack: arms")
    assert {v.key: v.value for v in arms.values} == {
        "state": "sweep 1", "halted": "the tumor moved by 6 mm",
    }  # fmt: skip
    assert sent(working())["diagnostics"].status[1].level == 0


def test_markers_keep_their_rate_and_changes_come_at_once():
    cell = ResultMessages(HUMBLE, with_arms(), hz=0.01)
    assert len(sent(working(0), cell)["workcell"].markers) == 3
    later = sent(working(1, 0.2), cell)
    assert "workcell" not in later
    assert later["joint_states"].position[0] == pytest.approx(0.04)  # joints come each time
    # Whoever is slow gets the newest message alone: each is whole.
    out = sent(less(working(2, 0.3), "holder/tip", "cut/2"), cell)
    assert [(m.ns, m.action) for m in out["workcell"].markers[:1]] == [("cut/2", 2)]
    assert [m.ns for m in out["workcell"].markers[1:]] == ["cut/1", "state"]
    assert [m.ns for m in out["links"].markers[1:]] == NAMES[:-1]
    assert out["links"].markers[0].action == 3  # DELETEALL
    cut = less(working(2, 0.3), "holder/tip", "cut/2")  # begins: the electrode's colour changes
    assert cut.control is not None
    shapes = tuple(
        replace(shape, colour=(70, 0, 255)) if shape.name == "cutter/tip" else shape
        for shape in cut.control.shapes
    )
    cut = replace(cut, control=replace(cut.control, shapes=shapes))
    (red,) = (m for m in sent(cut, cell)["links"].markers if m.ns == "cutter/tip")
    assert (red.color.r, red.color.b) == (pytest.approx(70 / 255), 1.0)
    assert "links" not in sent(cut, cell)
    halted = less(working(3, 0.3, "hidden"), "holder/tip", "cut/2")
    assert sent(halted, cell)["workcell"].markers[-1].text == "sweep 1, halted: hidden"
    assert "workcell" not in sent(halted, cell)
    gone = sent(small_update(2, frames=TABLE), cell)
    for topic in ("workcell", "links"):
        (all_gone,) = gone[topic].markers
        assert all_gone.action == all_gone.DELETEALL
    nothing = sent(replace(working(3), control=None), cell)
    assert len(nothing["joint_states"].name) == 0
    assert nothing["diagnostics"].status[1].level == 3  # STALE


def test_what_the_camera_saw_is_sent_in_the_frame_of_the_arms():
    update = working()
    assert update.observation is not None
    points_mm = cloud_of(sent(update)["observed"]).points_mm
    depth_mm = update.observation.content.depth_mm
    assert len(points_mm) == np.isfinite(depth_mm).sum()
    # The camera looks down from 160 mm: a depth of d is a height of 160 - d.
    assert np.sort(points_mm[:, 2]) == pytest.approx(
        np.sort(160 - depth_mm[np.isfinite(depth_mm)]), abs=1e-3
    )
    arms = {"workcell", "joint_states", "observed", "planned", "links"}
    assert not arms & sent(update, ResultMessages(HUMBLE, small_setting())).keys()
    slow = ResultMessages(HUMBLE, with_arms(), hz=0.01)
    assert "observed" in sent(update, slow)
    assert "observed" not in sent(update, slow)
    assert sent(virtual(), slow)["observed"].width == 0


def test_what_neither_moves_nor_deforms_is_sent_once_and_kept_for_latecomers():
    messages = ResultMessages(HUMBLE, with_arms())
    planned = tuple(
        RigidShape(f"planned/{name}", mesh, np.eye(4), (1, 2, 3), still=True)
        for name, mesh in small_update().estimate.meshes.items()
    )

    def out(n, *more):
        cell = working(n, 0.1 * n).control
        update = replace(working(n), control=replace(cell, shapes=(*more, *cell.shapes)))
        return {one.suffix: one for one in messages.messages(update)}

    first = out(0, *planned)
    names = [marker.ns for marker in first["planned"].message.markers]
    assert names[1:] == [shape.name for shape in planned]
    lifetimes = {marker.lifetime.sec for marker in first["planned"].message.markers}
    assert lifetimes == {0}
    for n in (1, 2):
        later = out(n, *planned)
        assert "planned" not in later
        moving = {one.child_frame_id for one in later["/tf"].message.transforms}
        assert {f"tumortrack/{name}" for name in NAMES} < moving
        assert not {f"tumortrack/{name}" for name in names[1:]} & moving
    links = [marker.ns for marker in first["links"].message.markers]
    assert links[1:] == NAMES
    (gone,) = out(3)["planned"].message.markers
    assert gone.action == gone.DELETEALL


@pytest.fixture
def slicer() -> Iterator:
    """A sink and a receiver of it."""
    used: list = []

    def opened(setting: SinkContext, **options):
        sink = OpenIgtLinkSinkConfig(port=0, **options).open(setting)
        receiver = socket.create_connection(("127.0.0.1", sink.link.port))
        used.extend((receiver, sink))
        until(lambda: sink.link.receivers)
        return sink, receiver

    yield opened
    for one in used:
        one.close()


def test_tips_and_the_arms_state_go_to_slicer(slicer):
    sink, receiver = slicer(with_arms())
    update = working(4, 0.25)
    sink.publish(update)
    heard = hear_all(receiver, 6 + 3)
    assert status_by_the_book(heard["STATUS", "arms"].content) == IgtlStatus(1, "sweep 1", "")
    shapes = {shape.name: shape for shape in update.control.shapes}
    for name in ("cutter/tip", "holder/tip"):
        place = unpack_transform(heard["TRANSFORM", name].content)
        x, y, z = shapes[name].published_from_shape[:3, 3]
        np.testing.assert_allclose(place[:3, 3], [-x, -y, z], atol=1e-4)  # RAS
        assert heard["TRANSFORM", name].metadata["frame_id"] == "table"
    sink.publish(less(virtual(5, halted="it is hidden"), "cutter/tip"))
    heard = hear_all(receiver, 4 + 2)
    assert status_by_the_book(heard["STATUS", "tumortrack"].content).text == REASON
    assert status_by_the_book(heard["STATUS", "arms"].content) == IgtlStatus(
        13, "sweep 1", "it is hidden"
    )
    assert [device for kind, device in heard if kind == "TRANSFORM"] == ["holder/tip"]
    sink.close()
    heard = hear_all(receiver, 4 + 1)
    assert status_by_the_book(heard["STATUS", "arms"].content).code == 16
    assert "TRANSFORM" not in {kind for kind, _ in heard}
