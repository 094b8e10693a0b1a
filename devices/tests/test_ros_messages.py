"""ROS messages: read from any layout, refused where they lie about themselves, written as ROS's own
classes read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from live_objects import (
    CAMERA,
    PARTS,
    STAMP_NS,
    empty_update,
    small_anatomy,
    small_estimate,
    small_frame,
    small_setting,
    small_update,
)
from refused import refused
from reports import bounded
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.core.types import SensorCloud
from tumortrack.live.values import ControlState, Observation, PublishedFrame
from tumortrack_devices.ros.messages import Messages, stamp_of
from tumortrack_devices.ros.results import ResultMessages
from tumortrack_devices.ros.sensors import (
    CAMERA_INFO,
    CLOUD,
    IMAGE,
    cloud_of,
    depth_of,
    mask_of,
    messages_seen,
    picture_of,
)
from workcell_objects import virtual, with_arms, working

HUMBLE, NOETIC = Messages("humble"), Messages("noetic")
POINTS_M = np.array([[0.01, -0.02, 0.125], [0.003, 0.004, 0.13], [-0.05, 0.0, 0.2]])
_TURN = Rotation.from_euler("xyz", [0.3, -1, 2]).as_matrix()
BARE = ControlState("hold")  # nothing to show but its state
TURNED = PublishedFrame("table", rigid(_TURN, np.array([50.0, -20, 9])))


def cloud_message(dtype: str = "<f4", **changes) -> object:
    """A cloud of ``POINTS_M`` whose x, y, z lie after other fields, in the order z, x, y."""
    size = int(dtype[2])
    table = np.zeros(
        len(POINTS_M),
        {
            "names": ["z", "x", "y"],
            "formats": [dtype] * 3,
            "offsets": [3, 3 + size, 5 + 2 * size],
            "itemsize": 40,
        },
    )
    table["x"], table["y"], table["z"] = POINTS_M.T
    fields = [
        HUMBLE.make("sensor_msgs/msg/PointField", name=n, offset=o, datatype=t, count=1)
        for n, o, t in [
            ("tag", 0, 2),
            *((axis, table.dtype.fields[axis][1], {4: 7, 8: 8}[size]) for axis in "zxy"),
        ]
    ]
    given = {
        "header": HUMBLE.header(STAMP_NS, "arm"),
        "height": 1,
        "width": len(table),
        "fields": fields,
        "is_bigendian": dtype[0] == ">",
        "point_step": 40,
        "row_step": 40 * len(table),
        "data": np.frombuffer(table.tobytes(), np.uint8),
    }
    return HUMBLE.make(CLOUD, **(given | changes))


def image_message(values: np.ndarray, encoding: str, pad: int = 0, **changes) -> object:
    """An image with ``pad`` bytes of rubbish behind each row."""
    rows = values.view(np.uint8).reshape(len(values), -1)
    rows = np.hstack([rows, np.full((len(rows), pad), 171, np.uint8)])
    given = {
        "header": HUMBLE.header(STAMP_NS, "arm"),
        "height": values.shape[0],
        "width": values.shape[1],
        "encoding": encoding,
        "is_bigendian": int(values.dtype.byteorder == ">"),
        "step": rows.shape[1],
        "data": rows.ravel(),
    }
    return HUMBLE.make(IMAGE, **(given | changes))


def info_message(messages: Messages = HUMBLE, **changes) -> object:
    given = {
        "header": messages.header(STAMP_NS, "arm"),
        "height": 2,
        "width": 3,
        "d": np.zeros(5),
        "k": np.array([6.0, 0, 1.25, 0, 6.5, 0.5, 0, 0, 1]),
        "p": np.array([5.0, 0, 1, 0, 0, 5.5, 0.75, 0, 0, 0, 1, 0]),
    }
    return messages.make(CAMERA_INFO, **(given | changes))


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8", ">f8"])
def test_clouds_of_any_layout_give_the_same_points_in_mm(dtype):
    cloud = cloud_of(cloud_message(dtype))
    np.testing.assert_allclose(cloud.points_mm, POINTS_M * 1000, rtol=1e-6)
    assert cloud.stamp_ns == STAMP_NS


def test_an_organised_cloud_with_padded_rows_loses_only_points_without_return():
    grid = np.full((2, 3, 4), 7, np.float32)
    grid[..., :3] = np.arange(18).reshape(2, 3, 3) / 100 + 0.01
    grid[0, 1, 2], grid[1, 0, :3], grid[1, 2, 0] = np.nan, 0, np.inf
    rows = np.hstack([grid.reshape(2, -1).view(np.uint8), np.full((2, 9), 255, np.uint8)])
    fields = [
        NOETIC.make("sensor_msgs/msg/PointField", name=n, offset=4 * i, datatype=7, count=1)
        for i, n in enumerate("xyz")
    ]
    sizes = {"height": 2, "width": 3, "point_step": 16, "row_step": rows.shape[1]}
    header = NOETIC.header(5, "")
    message = NOETIC.make(CLOUD, header=header, fields=fields, data=rows.ravel(), **sizes)
    expected = grid[[0, 0, 1], [0, 2, 1], :3] * 1000
    np.testing.assert_allclose(cloud_of(message).points_mm, expected, rtol=1e-6)


WRONG = {
    "cloud": (
        *({"width": 4}, {"width": 2**32 - 1, "height": 2**32 - 1}, {"height": 2**31}),
        *({"height": 2, "width": 2, "row_step": step} for step in (79, 81)),
        *({"point_step": 10}, {"point_step": 0}, {"data": np.zeros(119, np.uint8)}, {"fields": []}),
    ),
    "image": (
        *({"height": 3}, {"width": 2**31, "height": 2**31}, {"width": 0}, {"step": 5}),
        *({"step": 2**32 - 1}, {"data": np.zeros(11, np.uint8)}, {"encoding": "bgr8"}),
    ),
    "camera": (
        *({"binning_x": 2}, {"width": 4}, {"k": np.zeros(9)}, {"k": np.full(9, np.nan)}),
        {"roi": HUMBLE.make("sensor_msgs/msg/RegionOfInterest", x_offset=1)},
        {"roi": HUMBLE.make("sensor_msgs/msg/RegionOfInterest", width=2, height=2)},
    ),
}


@pytest.mark.parametrize(
    ("what", "change"), [(what, change) for what, some in WRONG.items() for change in some]
)
def test_messages_that_lie_about_themselves_are_refused(what, change):
    ones, whole = np.ones((2, 3), np.uint16), {"encoding": "16UC1"}
    read = {
        "cloud": lambda: cloud_of(cloud_message(**change)),
        "image": lambda: depth_of(image_message(ones, **(whole | change)), info_message()),
        "camera": lambda: depth_of(image_message(ones, **whole), info_message(**change)),
    }[what]
    with pytest.raises(InputError):
        read()


@pytest.mark.parametrize(
    "change", [{"datatype": 5}, {"count": 3}, {"offset": 37}, {"offset": 2**32 - 1}]
)
def test_clouds_with_unusable_coordinates_are_refused(change):
    message = cloud_message()
    vars(message.fields[1]).update(change)
    with refused(InputError, " z "):
        cloud_of(message)


@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "dtype", "scale"),
    [
        ("16UC1", "<u2", 1),
        ("16UC1", ">u2", 1),
        ("mono16", "<u2", 1),
        ("32FC1", "<f4", 1000),
        ("32FC1", ">f4", 1000),
    ],
)
def test_depth_images_of_any_encoding_give_the_same_frame(encoding, dtype, scale, pad):
    depth_mm = np.array([[120, 0, 65534], [1, 300, 65535]], float)
    image = image_message((depth_mm / scale).astype(dtype), encoding, pad)
    frame = depth_of(image, info_message())
    expected = np.where((depth_mm > 0) & (depth_mm < 65535), depth_mm, np.nan)
    np.testing.assert_allclose(frame.depth_mm, expected, rtol=1e-6)
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (6.0, 1.25)
    assert (frame.intrinsics.fy, frame.intrinsics.cy) == (6.5, 0.5)
    assert frame.stamp_ns == STAMP_NS


def test_a_camera_info_of_another_camera_or_of_none_is_refused():
    image = image_message(np.full((2, 3), 150, "<u2"), "16UC1")
    nameless, other = (HUMBLE.header(STAMP_NS, name) for name in ("", "leg"))
    assert depth_of(image, info_message(header=nameless)).stamp_ns == STAMP_NS
    with refused(InputError, "'arm'", "'leg'"):
        depth_of(image, info_message(header=other))
    for focal in (0.2, 16.0, 600.0):  # of 3 pixels: 0.3 to 15
        k = np.array([focal, 0, 1.25, 0, 6.5, 0.5, 0, 0, 1])
        with refused(InputError, "3 x 2"):
            depth_of(image, info_message(k=k))


def test_a_rectified_image_has_the_camera_of_p_in_either_ros():
    image = image_message(np.ones((2, 3), np.uint16), "16UC1")
    for messages in (HUMBLE, NOETIC):
        info = info_message(messages, d=np.array([0.1, 0, 0, 0, 0]))
        assert depth_of(image, info, rectified=True).intrinsics.fx == 5.0
        with pytest.raises(InputError):
            depth_of(image, info)


def test_a_mask_is_what_is_not_zero():
    values = np.array([[0, 1, 255], [7, 0, 0]], np.uint8)
    np.testing.assert_array_equal(mask_of(image_message(values, "mono8", 3)), values > 0)
    with refused(InputError, "16UC1"):
        mask_of(image_message(values.astype(np.uint16), "16UC1"))


def test_a_picture_is_red_green_and_blue_of_the_depth_image_s_pixels_and_moment():
    frame = small_frame(STAMP_NS)
    shape = (*frame.depth_mm.shape, 3)
    rgb = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
    bgr = image_message(rgb[..., ::-1].copy(), "bgr8", 5)
    np.testing.assert_array_equal(picture_of(bgr, frame), rgb)
    assert picture_of(bgr, small_frame(STAMP_NS + 1)) is None
    four = np.dstack([rgb[..., ::-1], np.full(shape[:2], 255, np.uint8)])
    np.testing.assert_array_equal(picture_of(image_message(four, "bgra8", 5), frame), rgb)
    four = np.dstack([rgb, four[..., 3]])
    np.testing.assert_array_equal(picture_of(image_message(four, "rgba8"), frame), rgb)
    grey = image_message(rgb[..., 0].copy(), "mono8")
    np.testing.assert_array_equal(picture_of(grey, frame), rgb[..., 0])
    with pytest.raises(InputError):
        picture_of(image_message(rgb[1:, :, 0].copy(), "mono8"), frame)
    with refused(InputError, "16UC1"):
        picture_of(image_message(rgb[..., 0].astype(np.uint16), "16UC1"), frame)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_damaged_bytes_are_refused_or_read_but_nothing_else(data):
    """Cut off, or with some bytes changed: an InputError, or a cloud."""
    messages = data.draw(st.sampled_from([HUMBLE, NOETIC]))
    cloud = SensorCloud(np.float32([[1, 2, 130], [3, 4, 140]]), STAMP_NS)
    ((_, kind, message),) = messages_seen(Observation(cloud, 0), messages)
    raw = bytearray(messages.to_bytes(message))
    for _ in range(data.draw(st.integers(0, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(raw)))
    try:
        points = cloud_of(messages.from_bytes(bytes(raw[:cut]), kind)).points_mm
    except InputError:
        return
    assert len(points) <= len(raw) / 12


@pytest.mark.parametrize("messages", [HUMBLE, NOETIC])
def test_what_was_seen_comes_back(messages):
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[3:9, 4:40] = True
    out = {m.suffix: m for m in messages_seen(Observation(small_frame(), 0, mask), messages, "cam")}
    image, info, seen_mask = (
        messages.from_bytes(messages.to_bytes(out[s].message), out[s].message_type)
        for s in ("depth/image_rect", "depth/camera_info", "mask")
    )
    frame, sent = depth_of(image, info), small_frame()
    assert frame.intrinsics == CAMERA
    assert frame.stamp_ns == STAMP_NS
    assert image.header.frame_id == "cam"
    np.testing.assert_array_equal(np.isnan(frame.depth_mm), np.isnan(sent.depth_mm))
    np.testing.assert_allclose(frame.depth_mm, sent.depth_mm, rtol=2e-7)
    np.testing.assert_array_equal(np.rint(frame.depth_mm * 10), np.rint(sent.depth_mm * 10))
    np.testing.assert_array_equal(mask_of(seen_mask), mask)

    cloud = SensorCloud(small_estimate().cloud.points_mm, STAMP_NS)
    ((suffix, kind, message),) = messages_seen(Observation(cloud, 0), messages)
    back = cloud_of(messages.from_bytes(messages.to_bytes(message), kind))
    assert (suffix, back.stamp_ns) == ("points", STAMP_NS)
    np.testing.assert_allclose(back.points_mm, cloud.points_mm, rtol=2e-7)


def by_suffix(update, results: ResultMessages | None = None):
    results = results or ResultMessages(HUMBLE, small_setting())
    return {out.suffix: out.message for out in results.messages(update)}


def headers_of(message) -> list:
    if hasattr(message, "header"):
        return [message.header]
    names = ("transforms", "markers")
    return [one.header for name in names for one in getattr(message, name, ())]


@pytest.mark.parametrize(
    "update", [small_update(frames=TURNED), replace(empty_update(), published_frame=TURNED)]
)
def test_every_message_has_the_update_s_stamp_and_frame(update):
    """A pose that is not valid has the stamp 0, as CRTK wants it."""
    out = by_suffix(update)
    poses = [out.pop(name).header for name in list(out) if "measured_cp" in name]
    headers = [h for message in out.values() for h in headers_of(message)]
    assert len(headers) >= 6
    assert {stamp_of(h) for h in headers} == {update.stamp_ns}
    assert {stamp_of(h) for h in poses} == {update.stamp_ns if update.estimate else 0}
    assert len(poses) == 2 * len(PARTS)
    assert {h.frame_id for h in (*headers, *poses)} == {"table"}


def test_an_estimate_is_sent_in_metres_in_the_published_frame():
    update = small_update(frames=TURNED)
    update = replace(update, estimate=bounded(update.estimate, tumor_1=2.34))
    out, placed = by_suffix(update), update.transformed
    np.testing.assert_allclose(cloud_of(out["cloud"]).points_mm, placed.points_mm, rtol=1e-5)
    table = np.frombuffer(
        out["cloud"].data,
        {
            "names": [f.name for f in out["cloud"].fields],
            "formats": [{7: "<f4", 2: "u1"}[f.datatype] for f in out["cloud"].fields],
            "offsets": [f.offset for f in out["cloud"].fields],
            "itemsize": out["cloud"].point_step,
        },
    )
    np.testing.assert_array_equal(table["label"], placed.labels)
    np.testing.assert_array_equal(table["probability"], placed.probability)
    assert len(np.unique(table["rgb"])) == len(np.unique(placed.labels))

    meshes = {m.ns: m for m in out["meshes"].markers}
    assert list(meshes) == [*PARTS, "quality"]
    for name, mesh in placed.meshes.items():
        corners = np.vstack(list(meshes[name].points))
        np.testing.assert_allclose(corners * 1000, mesh.vertices_mm[mesh.faces.ravel()])
        assert meshes[name].type == meshes[name].TRIANGLE_LIST
    assert meshes["kidney"].color.a < 0.5 < meshes["tumor_1"].color.a
    assert all(marker.lifetime.sec > 0 for marker in meshes.values())
    lines = meshes["quality"].text.splitlines()
    assert max(map(len, lines)) <= 44  # RViz breaks none
    assert " ".join(lines) == (
        "good: no check failed; its place is not verified; tumor_1 off by at most 2.3 mm (95 %)"
    )
    spot = meshes["quality"].pose.position
    here_mm = [1000 * spot.x, 1000 * spot.y, 1000 * spot.z, 1]
    camera_mm = np.linalg.inv(TURNED.published_from_camera) @ here_mm
    highest_mm = small_anatomy().organ.box_mm[0, 1]
    assert camera_mm[1] + 10.0 * (len(lines) - 1) < highest_mm  # its middle: all lies above

    point = out["tumor_1/center"].point
    middle = small_anatomy().parts[1].box_mm.mean(0)
    expected = TURNED.published_from_camera @ [*middle, 1] / 1000
    np.testing.assert_allclose([point.x, point.y, point.z], expected[:3])
    (status,) = out["diagnostics"].status
    said = {v.key: v.value for v in status.values}
    assert (status.level, said["latency_ms"], said["search_ms"]) == (0, "12.500", "3.000")
    assert said["points"] == "80"
    assert (said["patient"], said["side"]) == ("P1", "left")


def test_without_an_estimate_every_topic_says_so():
    out = by_suffix(empty_update(reason="the drape hides it"))
    assert (out["cloud"].width, len(out["cloud"].data)) == (0, 0)
    assert len(out["cloud"].fields) == 6
    first, text = out["meshes"].markers
    assert first.action == first.DELETEALL
    assert "the drape hides it" in text.text
    for name in PARTS:
        point = out[f"{name}/center"].point
        assert np.isnan([point.x, point.y, point.z]).all()
    (status,) = out["diagnostics"].status
    assert (status.level, status.message) == (2, "none, no estimate: the drape hides it")


def test_a_part_that_was_not_found_is_deleted_and_meshes_may_wait():
    estimate = small_estimate()
    del estimate.meshes["tumor_1"]
    update = replace(small_update(), estimate=estimate, quality="poor", warning="few points")
    markers = {m.ns: m for m in by_suffix(update)["meshes"].markers}
    assert markers["tumor_1"].action == markers["tumor_1"].DELETE
    assert markers["tumor_2"].action == markers["tumor_2"].ADD
    assert np.isnan(by_suffix(update)["tumor_1/center"].point.x)
    assert by_suffix(update)["diagnostics"].status[0].level == 1
    slow = ResultMessages(HUMBLE, small_setting(), hz=0.01)
    assert len(by_suffix(update, slow)["meshes"].markers) == 4
    assert [m.ns for m in by_suffix(update, slow)["meshes"].markers] == ["quality"]


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_stamps_that_ros_cannot_say_are_refused(stamp_ns):
    with refused(InputError, 2038):
        HUMBLE.header(stamp_ns, "camera")


@pytest.mark.parametrize(
    "update",
    [small_update(), empty_update(), working(), virtual(), replace(working(), control=BARE)],
)
def test_bytes_are_those_of_plain_messages(update):
    """Blocks of points are written as the library writes lists of points."""
    stock = get_typestore(Stores.ROS2_HUMBLE)
    for out in ResultMessages(HUMBLE, with_arms()).messages(update):
        raw, kind = HUMBLE.to_bytes(out.message), out.message_type
        again = stock.serialize_cdr(stock.deserialize_cdr(raw, kind), kind)
        assert bytes(again) == bytes(raw), out.suffix
