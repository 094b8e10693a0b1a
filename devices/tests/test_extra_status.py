"""What to touch next and what is known beside the clouds: where sinks show it, and when not."""

from __future__ import annotations

import socket
import struct
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clock import until
from igtl_objects import hear_all
from live_objects import STAMP_NS, empty_update, small_setting, small_update
from motions import Wave
from reports import advised as with_advice
from reports import reporting
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.report import Finding
from tumortrack.live.values import PublishedFrame, TrackingResult
from tumortrack_devices.extra_status import ExtraStatus
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import ResultMessages
from tumortrack_devices.sinks.openigtlink import OpenIgtLinkSinkConfig
from tumortrack_devices.sinks.viewer import ViewerSinkConfig
from viewer_page import LOOK, page

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
ROBOT = PublishedFrame("robot", rigid(TURN, np.array([400.0, -250.0, 90.0])))
POINTS_CT = np.array([[12.0, -8.0, 30.0], [-20.0, 4.0, 6.0], [3.0, 25.0, -11.0]])
BOUND_MM = (1.34, 0.93, 0.81, 0.78)
LABELS = ["1: 1.3 -> 0.9 mm", "2: 0.9 -> 0.8 mm", "3: 0.8 -> 0.8 mm"]
MISS = Finding("miss", {"part": "tumor_1", "error_bound95_mm": 4.0})
RIVAL = Finding("alternative", {"part": "tumor_1", "distance_mm": 12.0})
KNOWN_MM, FAR_MM, FREE_MM = [3.0, 1.0, 108.0], [40.0, 2.0, 130.0], [9.0, 9.0, 90.0]


@dataclass(frozen=True)
class Moved(Wave):
    """A wave, and a shift along each axis, mm."""

    by_mm: float = 0.0

    def forward(self, points_ct: np.ndarray) -> np.ndarray:
        return super().forward(points_ct) + self.by_mm

    def inverse(self, points_camera: np.ndarray) -> np.ndarray:
        return super().inverse(points_camera - self.by_mm)


NOW, THEN = Moved(5.0), Moved(8.0, by_mm=6.0)


def published(points_ct: np.ndarray, motion: Wave) -> np.ndarray:
    return transform_points(ROBOT.published_from_camera, motion.forward(points_ct))


def told(
    sequence: int = 0,
    motion: Wave = NOW,
    advised: bool = True,
    points_ct: np.ndarray = POINTS_CT,
    **evidence,
) -> TrackingResult:
    """A result with advice on three points, and with evidence of these names."""
    update = small_update(sequence, STAMP_NS + sequence * 1_000_000_000, ROBOT)
    advice = [
        {
            "kind": "touch", "part": "tumor_1", "place_mm": place.tolist(),
            "direction": (0.0, 0.0, -1.0), "std_mm": 1.0, "then_std_mm": 0.9,
            "bound_mm": BOUND_MM[n], "then_bound_mm": BOUND_MM[n + 1],
        }
        for n, place in enumerate(motion.forward(points_ct))
    ]  # fmt: skip
    advice.append({**advice[0], "kind": "view"})
    pieces = [
        {
            "name": name,
            "off_mm": 1.0,
            "information_gain": 0.5,
            "rejected": out,
            "places_mm": [place],
        }
        for name, (place, out) in evidence.items()
    ]
    estimate = reporting(update.estimate, evidence=pieces)
    estimate = with_advice(estimate, advice if advised else [])
    return replace(update, estimate=replace(estimate, motion=motion))


def places(extra_status: ExtraStatus) -> np.ndarray:
    return np.reshape([touch.place_mm for touch in extra_status.touches], (-1, 3))


def test_touches_move_with_the_organ():
    extra_status = ExtraStatus()
    extra_status.update(told())
    assert places(extra_status) == pytest.approx(published(POINTS_CT, NOW), abs=1e-3)
    extra_status.update(told(1, THEN, advised=False))
    there = published(POINTS_CT, THEN)
    assert np.linalg.norm(there - published(POINTS_CT, NOW), axis=1).min() > 5
    assert places(extra_status) == pytest.approx(there, abs=1e-3)
    assert [touch.label for touch in extra_status.touches] == LABELS
    x, y, z = np.rint(extra_status.touches[0].place_mm).astype(int)
    assert (
        extra_status.touches[0].message
        == f"touch the organ at {x}, {y}, {z} mm: tumor_1 1.3 -> 0.9 mm"
    )


@pytest.mark.parametrize(
    ("quality", "finding", "count"),
    [("good", None, 3), ("poor", MISS, 3), ("poor", RIVAL, 0), ("poor", None, 0)],
)
def test_no_place_is_worth_touching_on_an_organ_that_may_lie_elsewhere(quality, finding, count):
    extra_status = ExtraStatus()
    extra_status.update(told())
    extra_status.update(replace(told(1), quality=quality, finding=finding))
    assert len(extra_status.touches) == count
    extra_status.update(told(2, advised=False))  # good again, and no new advice yet
    assert len(extra_status.touches) == count


def test_without_an_estimate_nothing_is_advised_nor_afterwards():
    extra_status = ExtraStatus()
    extra_status.update(told(touch=(KNOWN_MM, False), outline=(FAR_MM, True)))
    assert len(extra_status.contradicting_mm) == 1
    extra_status.update(replace(empty_update(1), published_frame=ROBOT))
    assert not any(
        map(len, (extra_status.touches, extra_status.known_mm, extra_status.contradicting_mm))
    )
    extra_status.update(told(2, advised=False))
    assert not any(
        map(len, (extra_status.touches, extra_status.known_mm, extra_status.contradicting_mm))
    )


def test_what_contradicts_stays_in_sight_for_seconds_and_free_places_are_left_out():
    extra_status = ExtraStatus()
    known = {"touch": (KNOWN_MM, False), "free_space": (FREE_MM, False)}
    extra_status.update(told(**known, outline=(FAR_MM, True)))
    known_mm, far_mm = transform_points(ROBOT.published_from_camera, np.array([KNOWN_MM, FAR_MM]))
    for second in (1, 3):
        extra_status.update(told(second, **known))
        assert extra_status.known_mm == pytest.approx(known_mm[None])
        assert extra_status.contradicting_mm == pytest.approx(far_mm[None])
    extra_status.update(told(4, **known))
    assert not len(extra_status.contradicting_mm)


def test_the_viewer_shows_them_where_they_are_unless_they_are_switched_off():
    sink = ViewerSinkConfig(port=0, hz=60).open(replace(small_setting(), published_frame=ROBOT))
    with closing(sink):
        nodes = sink.server.scene.get_handle_by_name
        labels = [nodes(f"/estimate/next_{n}") for n in range(3)]
        sink.publish(told(touch=(KNOWN_MM, False), outline=(FAR_MM, True)))
        spots = nodes("/estimate/next")
        assert spots.points == pytest.approx(published(POINTS_CT, NOW), abs=1e-3)
        assert [label.text for label in labels] == LABELS
        assert np.array([label.position for label in labels]) == pytest.approx(spots.points)
        for name, place in (("known", KNOWN_MM), ("contradicting", FAR_MM)):
            there = transform_points(ROBOT.published_from_camera, np.array([place]))
            assert nodes(f"/estimate/{name}").points == pytest.approx(there, abs=1e-3)
        assert spots.visible
        assert all(label.visible for label in labels)
        with page(sink) as visitor:
            for on in (False, True):
                visitor.change("Evidence, next touches", on)
                until(lambda on=on: spots.visible is on, "the change")
                for node in (nodes("/estimate/known"), *labels):
                    until(lambda on=on, node=node: node.visible is on, "the change")
        sink.publish(replace(empty_update(1), published_frame=ROBOT))
        for name in ("next", "known", "contradicting"):
            assert not len(nodes(f"/estimate/{name}").points)
        assert not any(label.visible for label in labels)


def test_a_place_behind_a_tumor_has_no_label():
    sink = ViewerSinkConfig(port=0).open(replace(small_setting(), published_frame=ROBOT))
    with closing(sink), page(sink) as visitor:
        update, place_mm = told(), published(POINTS_CT, NOW)[0]
        tumor_mm = update.transformed.meshes["tumor_1"].box_mm.mean(0)
        label = sink.server.scene.get_handle_by_name("/estimate/next_0")
        for share, bare in ((2.0, False), (-1.0, True)):  # beyond the tumor; on this side
            eye_mm = (place_mm + share * (tumor_mm - place_mm)).tolist()
            visitor.say("ViewerCameraMessage", **LOOK | {"position": eye_mm})

            def seen(bare: bool = bare) -> bool:
                sink.publish(update)
                return label.visible is bare and label.text == LABELS[0]

            until(seen, "the label")


def test_ros_has_them_as_spheres_with_texts_and_in_words():
    results = ResultMessages(Messages("humble"), small_setting())

    def sent(update: TrackingResult) -> dict:
        return {out.suffix: out.message for out in results.messages(update)}

    out = sent(told(touch=(KNOWN_MM, False), outline=(FAR_MM, True)))
    markers = {(m.ns, m.id): m for m in out["meshes"].markers}
    spots = markers["next_touch", 0]
    assert (spots.type, spots.scale.x) == (spots.SPHERE_LIST, pytest.approx(0.004))
    there_m = published(POINTS_CT, NOW) / 1000
    assert np.vstack(list(spots.points)) == pytest.approx(there_m, abs=1e-6)
    for n, label in enumerate(LABELS):
        text = markers["next_touch_text", n]
        spot = text.pose.position
        assert (text.type, text.text) == (text.TEXT_VIEW_FACING, label)
        assert [spot.x, spot.y, spot.z] == pytest.approx(there_m[n], abs=1e-6)
    assert markers["contradicting", 0].color.r > 2 * markers["contradicting", 0].color.g
    assert len(markers["evidence", 0].points) == 1
    said = {v.key: v.value for v in out["diagnostics"].status[0].values}
    assert said["next_touch_1"].endswith("tumor_1 1.3 -> 0.9 mm")
    out = sent(replace(told(1), quality="poor", finding=RIVAL))
    gone = {(m.ns, m.id) for m in out["meshes"].markers if m.action == m.DELETE}
    assert gone >= {("next_touch", 0), ("evidence", 0), *(("next_touch_text", n) for n in range(3))}
    assert not [v.key for v in out["diagnostics"].status[0].values if v.key.startswith("next")]


def test_slicer_gets_them_as_fiducials_and_an_empty_list_afterwards():
    sink = OpenIgtLinkSinkConfig(port=0, mesh_hz=0.0).open(small_setting())
    with closing(sink), socket.create_connection(("127.0.0.1", sink.link.port)) as sock:
        until(lambda: sink.link.receivers)
        sink.publish(told(advised=False))
        assert ("POINT", "next_touch") not in hear_all(sock, 4)
        sink.publish(told(1))
        content = hear_all(sock, 5)["POINT", "next_touch"].content
        heard = [struct.unpack("> 64s 32s 4B 4f 20s", content[n : n + 136]) for n in (0, 136, 272)]
        assert [one[0].rstrip(b"\0").decode() for one in heard] == LABELS
        there = published(POINTS_CT, NOW) * [-1, -1, 1]
        assert np.array([one[6:9] for one in heard]) == pytest.approx(there, abs=1e-3)
        sink.publish(replace(told(2), quality="poor", finding=RIVAL))
        assert hear_all(sock, 5)["POINT", "next_touch"].content == b""
