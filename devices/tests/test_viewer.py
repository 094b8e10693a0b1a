"""The web viewer: what it computes and sends; its page is in `test_viewer_page`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from clock import Clock, until
from live_objects import PARTS, ball, empty_update, small_anatomy, small_setting, small_update
from refused import refused
from reports import bounded, reporting
from tumortrack.core.colours import ENERGISED, TUMORS, part_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_query import exact_margin
from tumortrack.core.patient import Patient
from tumortrack.core.report import EvidenceReport, Finding
from tumortrack.core.store import new_folder
from tumortrack.core.types import Anatomy, LabelVolume, Mesh, Volume
from tumortrack.io.case import Case, save_case
from tumortrack.live.values import PublishedFrame, SinkContext, TrackingResult
from tumortrack.report.slices import CarriedCt, SlicePlane
from tumortrack_devices.display import seen_points
from tumortrack_devices.sinks.viewer import ViewerSink, ViewerSinkConfig, slice_picture
from tumortrack_devices.viewer.look import point_under
from tumortrack_devices.viewer.panel import StatusPanel
from tumortrack_devices.viewer.scene import bare_faces
from viewer_page import page
from workcell_objects import virtual, with_arms, workcell, working

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
ROBOT = PublishedFrame("robot", rigid(TURN, np.array([400.0, -250.0, 90.0])))


@dataclass(frozen=True, eq=False)
class Turned:
    """A motion that is a rotation and a shift."""

    camera_from_ct: np.ndarray

    def forward(self, points_ct: np.ndarray, /) -> np.ndarray:
        return transform_points(self.camera_from_ct, points_ct)

    def inverse(self, points_camera: np.ndarray, /) -> np.ndarray:
        return transform_points(np.linalg.inv(self.camera_from_ct), points_camera)

    def std_mm(self, points_ct: np.ndarray, /) -> None:
        return None

    largest_std_mm = covariance_mm2 = std_mm


MOTION = Turned(rigid(TURN, np.array([3.0, -2.0, 130.0])))


def bean() -> Mesh:
    """A closed surface with a bulge and a hollow."""
    sphere = trimesh.creation.icosphere(4, 1.0)
    v = sphere.vertices * [14, 9, 8]
    return Mesh(v + np.outer(0.02 * v[:, 0] ** 2, [0, 1, 0]) + [30, -20, 55], sphere.faces)


def sloped_case(with_ct: bool = True) -> Case:
    """A ball of 20 mm with one of 6 mm in it, in a CT whose values rise along a direction."""
    lps_from_index = np.diag([1.5, 1.5, 2.0, 1.0])
    lps_from_index[:3, 3] = [-33.0, -33.0, -34.0]
    grid = np.indices((45, 45, 35)).reshape(3, -1).T.astype(float)
    points = transform_points(lps_from_index, grid)
    labels = (np.linalg.norm(points, axis=1) < 20).astype(np.uint8)
    labels[np.linalg.norm(points - [8.0, 0.0, 0.0], axis=1) < 6] = 2
    ct = Volume((points @ [2.0, -1.0, 0.5]).reshape(45, 45, 35), lps_from_index)
    volume = LabelVolume(labels.reshape(45, 45, 35), lps_from_index)
    anatomy = Anatomy((ball((0, 0, 0), 20.0), ball((8, 0, 0), 6.0)))
    return Case(anatomy, volume, (0.0, -1.0, 0.0), ct=ct if with_ct else None)


def carried_update(case: Case, motion: Turned = MOTION) -> TrackingResult:
    """An update whose estimate is the case's anatomy, moved by ``motion``."""
    update = small_update()
    assert update.estimate is not None
    names = ("kidney", "tumor_1")
    meshes = {
        name: part.with_vertices(motion.forward(part.vertices_mm))
        for name, part in zip(names, case.anatomy.parts, strict=True)
    }
    return replace(update, estimate=replace(update.estimate, meshes=meshes, motion=motion))


@pytest.fixture
def sinks():
    """Opens viewers at free ports, and closes them."""
    opened: list[ViewerSink] = []

    def open_viewer(setting: SinkContext | None = None, **options) -> ViewerSink:
        sink = ViewerSinkConfig(port=0, **options).open(setting or small_setting())
        opened.append(sink)
        return sink

    yield open_viewer
    for sink in opened:
        sink.close()
        sink.close()


def drawn(sink: ViewerSink, name: str) -> bool:
    """This surface of the estimate is on the page."""
    node = sink.server.scene.get_handle_by_name(f"/estimate/{name}")
    return node.visible and bool(np.ptp(node.vertices, axis=0).any())


# Surfaces


def test_margin_lies_at_its_distance_and_is_closed():
    tumor = bean()
    shell = exact_margin(tumor, 5.0)
    solid = trimesh.Trimesh(tumor.vertices_mm, tumor.faces)
    dense = trimesh.sample.sample_surface(solid, 200_000, seed=1)[0]
    distance, _ = cKDTree(dense).query(shell.vertices_mm)
    assert np.abs(distance - 5).max() < 0.3
    made = trimesh.Trimesh(shell.vertices_mm, shell.faces)
    assert made.is_watertight
    assert shell.volume_mm3 > tumor.volume_mm3  # faces outward, the tumor inside
    assert made.body_count == 1


def test_organ_leaves_out_what_is_a_tumors_surface():
    sphere = trimesh.creation.icosphere(4, 25.0)
    cap = trimesh.convex.convex_hull(sphere.vertices[sphere.vertices[:, 2] > 15])
    anatomy = Anatomy((Mesh(sphere.vertices, sphere.faces), Mesh(cap.vertices, cap.faces)))
    bare = bare_faces(anatomy)
    height = sphere.vertices[bare][:, :, 2]
    assert (height.min(1) <= 15).all()
    assert len(bare) == (sphere.vertices[sphere.faces][:, :, 2].min(1) <= 15).sum()


# Slices


@pytest.mark.parametrize("with_ct", [True, False])
def test_slice_shows_the_ct_where_it_is_now(with_ct):
    case = sloped_case(with_ct)
    ct = CarriedCt(case)
    across, down = np.array([1.0, 0, 0]), np.array([0, 0.6, 0.8])
    plane = SlicePlane(MOTION.forward(np.array([[2.0, 1.0, 0.0]]))[0], across, down, 24.0)
    picture = slice_picture(ct, MOTION, plane, [], 48)
    assert picture is not None
    rows, columns = (axis.ravel() for axis in np.mgrid[3:36:6, 2:46:7])  # the bar is below
    x, y = (columns - 23.5) / 2, (rows - 23.5) / 2  # mm from the middle
    places = MOTION.inverse(plane.centre_mm + np.outer(x, across) + np.outer(y, down))
    expected = ct.picture(places).astype(int)
    assert np.ptp(expected) > 60
    close = np.abs(picture[rows, columns].astype(int) - expected).max(1) <= 3
    assert close.all() if with_ct else close.mean() > 0.8  # labels are mixed at their borders


def test_grey_rises_with_the_ct_fades_and_ends():
    ct = CarriedCt(sloped_case())
    direction = np.array([2.0, -1.0, 0.5]) / np.sqrt(5.25)
    inside = ct.picture(np.outer([-12.0, 0.0, 12.0], direction))[:, 0].astype(int)
    steps = np.diff(inside)
    assert steps[0] > 30
    assert steps[0] == pytest.approx(steps[1], abs=1)
    right = ct.picture(np.array([[19.0, 0, 0], [30.0, 0, 0], [400.0, 0, 0]]))[:, 0]
    assert right[0] > right[1] > 0  # the CT is brighter there, but the organ is far
    assert right[2] == 0


def test_labels_have_their_parts_colours_and_nothing_is_round_them():
    labels = CarriedCt(sloped_case(with_ct=False))
    assert (labels.name, CarriedCt(sloped_case()).name) == ("Label map", "CT")
    kidney, tumor, *outside = labels.picture(
        np.array([[-9.0, 0, 0], [8.0, 0, 0], [26.0, 0, 0], [400.0, 0, 0]])
    )
    assert kidney / max(kidney) == pytest.approx(np.array(part_colour(1)) / 185, abs=0.02)
    assert tumor / max(tumor) == pytest.approx(np.array(TUMORS[0]) / 230, abs=0.02)
    assert not np.any(outside)


def test_slice_outlines_lie_on_the_surface():
    case = sloped_case()
    tumor = ball((8, 0, 0), 6.0)
    there = tumor.with_vertices(MOTION.forward(tumor.vertices_mm))
    middle = there.box_mm.mean(0)
    plane = SlicePlane(middle, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 32.0)
    picture = slice_picture(CarriedCt(case), MOTION, plane, [(there, (0, 255, 0), 1)], 128)
    assert picture is not None
    drawn = np.argwhere((picture[:, :, 1] > 200) & (picture[:, :, 0] < 60))
    assert len(drawn) > 60
    radius_mm = np.linalg.norm((drawn - 63.5) / 4, axis=1)
    assert radius_mm == pytest.approx(6.0, abs=0.35)


# Clicks


def test_click_means_the_foremost_point_under_it():
    points = np.array([[0.0, 0, 100], [0.5, 0, 140], [9.0, 0, 90], [0, 0, -50]])
    eye, ahead = np.zeros(3), np.array([0.0, 0, 2.0])
    assert point_under(points, eye, ahead) == pytest.approx([0, 0, 100])
    assert point_under(points[1:], eye, ahead) == pytest.approx([0.5, 0, 140])
    assert point_under(points[2:3], eye, ahead) == pytest.approx([9, 0, 90])
    assert point_under(points[3:], eye, ahead) is None  # behind
    assert point_under(points, np.array([60.0, 0, 0]), ahead) is None  # far off


# The sink


@pytest.fixture
def clock(monkeypatch):
    """The viewer's, which the test turns."""
    one = Clock()
    monkeypatch.setattr("tumortrack_devices.sinks.viewer.time", one)
    return one


@pytest.mark.parametrize("wrong", [{"port": 70_000}, {"hz": 0.0}, {"margin_mm": -1.0}])
def test_impossible_settings_are_refused(wrong):
    with refused(InputError, *wrong):
        ViewerSinkConfig(**wrong)


def test_without_estimate_nothing_stays_and_with_one_it_is_back_at_once(sinks, clock):
    sink = sinks(hz=0.01)
    nodes = sink.server.scene.get_handle_by_name
    sink.publish(small_update(0))
    assert drawn(sink, "kidney")
    sink.publish(empty_update(1))  # far sooner than hz allows
    assert not any(drawn(sink, name) for name in (*PARTS, "margin_tumor_1"))
    sink.publish(small_update(2, frames=ROBOT))
    assert drawn(sink, "kidney")
    there = transform_points(ROBOT.published_from_camera, small_anatomy().organ.vertices_mm)
    assert nodes("/estimate/kidney").vertices[: len(there)] == pytest.approx(there, abs=1e-3)
    first = nodes("/estimate/kidney").vertices.copy()
    sink.publish(small_update(3))  # too soon for another
    assert (nodes("/estimate/kidney").vertices == first).all()


def test_the_shell_is_as_far_off_as_the_tumor_may_be(sinks, clock):
    sink = sinks(hz=60)
    nodes = sink.server.scene.get_handle_by_name
    update = small_update(0)
    assert update.estimate is not None
    sink.publish(update)
    assert drawn(sink, "tumor_1")
    assert not drawn(sink, "margin_tumor_1")
    sure = bounded(update.estimate, tumor_1=3.0)
    clock.sleep(1 / 60)
    sink.publish(replace(update, estimate=sure))
    tumor, shell = (nodes(f"/estimate/{n}").vertices for n in ("tumor_1", "margin_tumor_1"))
    off_mm = np.linalg.norm(shell - tumor, axis=1)
    assert off_mm == pytest.approx(3.0, abs=1e-3)
    assert not drawn(sink, "margin_tumor_2")  # of which nothing is known
    assert sink.panel.stage.content.count("3.0 mm") == 1
    clock.sleep(1 / 60)
    sink.publish(replace(update, estimate=sure, quality="poor"))
    assert not drawn(sink, "margin_tumor_1")
    assert "3.0 mm" not in sink.panel.stage.content
    found = {name: mesh for name, mesh in update.estimate.meshes.items() if name != "tumor_1"}
    clock.sleep(1 / 60)
    sink.publish(replace(update, estimate=replace(sure, meshes=found)))
    assert [drawn(sink, name) for name in ("tumor_1", "margin_tumor_1", "tumor_2")] == [0, 0, 1]


def test_nothing_that_was_seen_lies_over_the_organ_unless_a_click_is_asked_for(sinks, clock):
    sink, nodes = sinks(hz=60), {}
    update = small_update()
    assert update.organ is not None
    seen, organ = seen_points(update.observation), update.organ.points_mm
    low, high = ((organ[:, :2] / organ[:, 2:]).min(0), (organ[:, :2] / organ[:, 2:]).max(0))
    before = ((seen[:, :2] / seen[:, 2:] >= low) & (seen[:, :2] / seen[:, 2:] <= high)).all(1)
    before &= seen[:, 2] <= organ[:, 2].max()
    assert 100 < before.sum() < len(seen) - 100
    with page(sink) as visitor:
        for asked in (False, True):
            if asked:
                visitor.change("Point at the organ")
                until(lambda: "cancel" in sink.panel.clicks[True].label, "the button")
            clock.sleep(1 / 60)
            sink.publish(replace(update, sequence=int(asked)))
            nodes[asked] = sink.server.scene.get_handle_by_name("/seen").points
    np.testing.assert_allclose(nodes[False], seen[~before], atol=1e-3)
    np.testing.assert_allclose(nodes[True], seen, atol=1e-3)


def test_a_camera_that_moves_is_shown_where_it_was_and_who_took_part_is_said(sinks, clock):
    sink = sinks(hz=60)
    for n in (0, 1):
        way = np.eye(4)
        way[:3, 3] = 10 * n, 20, -300
        frame = PublishedFrame("base", way, calibrated=True, moves=True)
        sink.publish(replace(small_update(n, frames=frame), cameras="cameras 1, 3; camera 2: gone"))
        nodes = sink.server.scene
        organ = small_update().organ.points_mm + way[:3, 3]
        np.testing.assert_allclose(nodes.get_handle_by_name("/organ").points, organ, atol=1e-3)
        np.testing.assert_allclose(nodes.get_handle_by_name("/camera").position, way[:3, 3])
        tumor = small_update().estimate.meshes["tumor_1"].vertices_mm + way[:3, 3]
        shown = nodes.get_handle_by_name("/estimate/tumor_1").vertices
        np.testing.assert_allclose(shown, tumor, atol=1e-3)
        clock.sleep(1 / 60)
    assert "cameras 1, 3; camera 2: gone" in sink.panel.stage.content


def test_estimate_that_cannot_be_shown_hides_the_one_before(sinks, clock):
    sink = sinks(hz=60)
    update = small_update(0)
    assert update.estimate is not None
    sink.publish(update)
    nowhere = PublishedFrame("base", np.zeros((4, 4)))
    clock.sleep(1 / 60)
    with refused(ValueError):
        sink.publish(replace(update, sequence=1, published_frame=nowhere))
    assert not drawn(sink, "kidney")
    said = sink.panel.stage.content
    assert "NONE" in said
    until(lambda: sink.panel.stage.content != said, "the watch's next word")
    assert "NONE" in sink.panel.stage.content


def test_case_gives_slices_and_an_exact_margin_that_moves_along(sinks, clock, tmp_path):
    case = sloped_case()
    with new_folder(tmp_path / "case") as folder:
        save_case(case, folder)
    setting = SinkContext(
        parts=PARTS[:2], published_frame=PublishedFrame(), anatomy_ct=case.anatomy
    )
    sink = sinks(setting, case=str(tmp_path / "case"), margin_mm=5.0)
    sink.publish(carried_update(case))
    until(lambda: sink.panel.slice.visible, "a slice")
    picture = sink.panel.slice.image
    assert (np.abs(picture.astype(int) - TUMORS[0]).sum(2) < 90).sum() > 30  # its outline
    shell = sink.server.scene.get_handle_by_name("/estimate/margin_tumor_1").vertices
    middle = MOTION.forward(np.array([[8.0, 0, 0]]))[0]
    assert np.linalg.norm(shell - middle, axis=1) == pytest.approx(11.0, abs=0.35)
    sink.publish(empty_update())
    assert not sink.panel.slice.visible

    assert "patient unknown, side unknown" in sink.panel.patient.content
    known = sinks(replace(setting, patient=Patient("P1", "left")), case=str(tmp_path / "case"))
    assert "patient P1, left side" in known.panel.patient.content
    with new_folder(tmp_path / "other") as folder:
        save_case(replace(case, patient=Patient("P2")), folder)
    with refused(InputError, "P2"):
        sinks(replace(setting, patient=Patient("P1")), case=str(tmp_path / "other"))
    with refused(InputError, "mm"):
        sinks(replace(setting, anatomy_ct=small_anatomy()), case=str(tmp_path / "case"))
    with pytest.raises(InputError):
        sinks(replace(setting, anatomy_ct=None), case=str(tmp_path / "case"))


def test_arms_move_without_being_sent_again_and_what_is_gone_is_removed(sinks, clock):
    sink = sinks(with_arms(), hz=60)
    nodes = sink.server.scene.get_handle_by_name
    sink.publish(working(0, 0.0))
    assert nodes("/workcell").visible
    forearm, cut = nodes("/workcell/shape/cutter:forearm"), nodes("/workcell/line/cut:1")
    assert len(cut.points) == 40
    now = working(1, 0.02).control
    assert now is not None
    moved = next(shape for shape in now.shapes if shape.name == "cutter/forearm")
    forearm_before = forearm.position.copy()
    mesh_before = next(s for s in workcell().shapes if s.name == "cutter/forearm").mesh
    clock.sleep(0.1)
    sink.publish(replace(working(1), control=now))
    assert (nodes("/workcell/shape/cutter:forearm") is forearm) == (moved.mesh is mesh_before)
    shown = nodes("/workcell/shape/cutter:forearm")
    assert shown.position == pytest.approx(moved.published_from_shape[:3, 3])
    assert not np.allclose(shown.position, forearm_before)
    turn = Rotation.from_quat(shown.wxyz, scalar_first=True).as_matrix()
    assert turn == pytest.approx(moved.published_from_shape[:3, :3])
    table = nodes("/workcell/shape/table")
    kept = tuple(shape for shape in now.shapes if shape.name != "holder/tip")
    clock.sleep(0.1)
    sink.publish(replace(working(2), control=replace(now, shapes=kept, lines=now.lines[1:])))
    assert nodes("/workcell/shape/holder:tip") is None
    assert nodes("/workcell/line/cut:1") is None
    assert nodes("/workcell/line/cut:2") is not None
    assert nodes("/workcell/shape/table") is table
    tip = nodes("/workcell/shape/cutter:tip")
    shapes = tuple(replace(s, colour=ENERGISED) if s.name == "cutter/tip" else s for s in kept)
    clock.sleep(0.1)
    sink.publish(replace(working(3), control=replace(now, shapes=shapes)))
    assert nodes("/workcell/shape/cutter:tip") is tip  # its surface is not sent again
    assert tuple(tip.color) == ENERGISED


def test_arms_are_shown_without_an_estimate_and_never_after_silence(sinks, clock):
    sink = sinks(with_arms())
    nodes = sink.server.scene.get_handle_by_name
    sink.publish(working(0))
    sink.publish(virtual(1))
    assert nodes("/workcell").visible
    assert not drawn(sink, "kidney")
    assert "PLAYBACK" in sink.panel.stage.content
    assert "not a live estimate" in sink.panel.stage.content
    assert "tumortrack-tint" not in sink.panel.stage.content
    look_at = sink.server.initial_camera.look_at
    assert look_at == pytest.approx(np.array([14, 3, 36]), abs=0.1)  # the cuts' middle
    sink.publish(small_update(2))
    assert not nodes("/workcell").visible
    nowhere = replace(workcell().shapes[0], published_from_shape=np.zeros((4, 4)))
    broken = replace(workcell(), shapes=(nowhere,))
    with refused(ValueError):
        sink.publish(replace(working(3), control=broken))
    assert not nodes("/workcell").visible
    assert drawn(sink, "kidney")
    clock.sleep(0.1)
    sink.publish(working(4))
    assert nodes("/workcell").visible
    clock.sleep(1.1)
    until(lambda: "nothing has come for" in sink.panel.stage.content, "silence")
    assert not nodes("/workcell").visible
    assert "nothing is known of them" in sink.panel.stage.content


def test_a_user_says_that_it_is_being_cut_and_that_it_was_not(sinks):
    setting = small_setting()
    sink = sinks(setting, hz=60)
    with page(sink) as visitor:
        visitor.change("It is being cut")
        until(setting.controls.cut.is_set, "the button")
        assert not sink.panel.acknowledge.visible
        poor = replace(small_update(), quality="poor", finding=Finding("cut_unknown"))
        sink.publish(poor)
        until(lambda: sink.panel.acknowledge.visible, "a way back")
        visitor.change("That was wrong")
        until(setting.controls.acknowledged.is_set, "the button")


def test_keys_and_buttons_say_that_a_tool_touches_and_the_panel_how_much_is_known(sinks):
    setting = replace(small_setting(), tools=("probe", "grasper"))
    sink = sinks(setting, hz=60)
    with page(sink) as visitor:
        for label in ("scissors", "grasper (key 2)", "probe (key 1)"):
            visitor.change("It touches", label)
        until(lambda: len(setting.controls.touched) == 2, "the touches")
    assert [*setting.controls.touched] == ["grasper", "probe"]
    said = [
        EvidenceReport(name="touch", off_mm=0.1, information_gain=0.2, rejected=out)
        for out in (False, True)
    ]
    update = small_update()
    sink.publish(replace(update, estimate=reporting(update.estimate, evidence=tuple(said))))
    assert "evidence: 1 in use, 1 left out" in sink.panel.stage.content


def test_status_says_why_and_no_old_numbers():
    update = replace(empty_update(), reason="depth < 110 mm & hidden")
    flag = StatusPanel("none", update, 0.1, 7).stage()
    assert "NONE" in flag
    assert "depth &lt; 110 mm &amp; hidden" in flag
    stale = StatusPanel("stale", small_update(), 3.21, 8)
    assert "3.2 s" in stale.stage()
    sure = small_update()
    assert sure.estimate is not None
    sure = replace(sure, estimate=bounded(sure.estimate, tumor_1=1.84))
    good = StatusPanel("good", sure, 0.1, 8, parts=PARTS).numbers()
    assert "off by at most (95 %)" in good
    assert "tumor 1</td><td>0.9 ml</td><td>1.8 mm</td>" in good
    assert "0.75" not in good  # a probability of points, which reads as certainty
    doubtful = StatusPanel("poor", replace(sure, quality="poor"), 0.1, 8, parts=PARTS).numbers()
    assert "tumor 1</td><td>0.9 ml</td><td>–</td>" in doubtful
    moving = replace(workcell(), note="1.2 mm are left")
    arms = StatusPanel("good", replace(small_update(), control=moving), 0.1, 9, arms=True)
    assert ">1.2 mm are left<" in arms.flag()
    assert " ml" not in stale._replace(parts=PARTS).numbers()
