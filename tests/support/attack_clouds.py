"""Hostile input: clouds, depth images, intrinsics and poses."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from attack import Make, Room, attacks

CPU = ("--device", "cpu")


def ply(points: np.ndarray) -> bytes:
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    ).encode() + points.astype("<f4").tobytes()


def pcd(viewpoint: str = "0 0 0 1 0 0 0", count: int = 3) -> bytes:
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH "
        f"{count}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {count}\nDATA binary\n"
    ).encode()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def right_points(room: Room) -> np.ndarray:
    from tumortrack.sense.files import read_cloud

    return np.array(read_cloud(room.cloud)[0].points_mm)


def file(content: Callable[[], bytes], name: str = "in.ply") -> Make:
    """`locate` in a file of such content."""
    return lambda room: ["locate", room.base / "model", room.file(name, content()), room.out, *CPU]


def cloud(change: Callable[[np.ndarray, np.random.Generator], Any]) -> Make:
    """`locate` in a right cloud that was changed."""

    def make(room: Room) -> list[object]:
        points = np.asarray(change(right_points(room), np.random.default_rng(0)))
        return file(lambda: ply(points))(room)

    return make


def with_right_cloud(*options: object) -> Make:
    return lambda room: ["locate", room.base / "model", room.cloud, room.out, *options]


def _about(change: Callable[[np.ndarray], np.ndarray]) -> Make:
    """A right cloud changed about its middle."""
    return cloud(lambda points, rng: change(points - points.mean(0)) + points.mean(0))


def _one(where: object, value: float) -> Make:
    def change(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        points[where] = value
        return points

    return cloud(change)


def _line(rng: np.random.Generator) -> np.ndarray:
    return np.outer(rng.uniform(0, 100, 5000), [0.9, 0.1, 0]) + [0, 0, 130]


def _ball_surface(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return (points.mean(0) + 35 * direction)[direction[:, 2] < 0]


def _ply_head(kind: str, count: object, *more: str) -> Make:
    lines = ["ply", f"format {kind} 1.0", f"element vertex {count}", *more]
    return file(lambda: "\n".join([*lines, ""]).encode())


def _pcd_from(viewpoint: str) -> Make:
    def make(room: Room) -> list[object]:
        points = right_points(room)
        return file(lambda: pcd(viewpoint, len(points)) + points.astype("<f4").tobytes(), "in.pcd")(
            room
        )

    return make


def _npz_bomb() -> bytes:
    """2 MB that unpack to 2.4 GB."""
    head, out = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f4", "fortran_order": False, "shape": (200_000_000, 3)}
    )
    with (
        zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("points_mm.npy", "w", force_zip64=True) as stream,
    ):
        stream.write(head.getvalue())
        for _ in range(2400):
            stream.write(bytes(1_000_000))
    return out.getvalue()


def png_of(width: int, height: int, bits: int, data: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        size, checksum = struct.pack(">I", len(body)), struct.pack(">I", zlib.crc32(kind + body))
        return size + kind + body + checksum

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def depth(change: Callable[[bytes], bytes] = bytes, text: str = "", **intrinsics: object) -> Make:
    """`locate` in a right depth image with changed pixels, or other intrinsics."""

    def make(room: Room) -> list[object]:
        given = json.loads(room.cloud.with_name("intrinsics.json").read_text()) | intrinsics
        image = room.file("in.png", change(room.cloud.with_name("depth.png").read_bytes()))
        written = room.file("intrinsics.json", (text or json.dumps(given)).encode())
        return ["locate", room.base / "model", image, room.out, "--intrinsics", written, *CPU]

    return make


def _image(width: int, height: int, bits: int, data: Callable[[], bytes]) -> Make:
    return depth(lambda _: png_of(width, height, bits, zlib.compress(data())))


def views(*poses: object) -> Make:
    """Two views of a right cloud, from such places."""

    def make(room: Room) -> list[object]:
        given = {"fixed_from_camera": poses, "unit": "mm", "frame_id": "base_link"}
        file = room.file("poses.json", json.dumps(given).encode())
        clouds = (room.cloud, room.cloud)
        return ["locate", room.base / "model", *clouds, room.out, "--poses", file, *CPU]

    return make


def _then(make: Make, change: Callable[[Room], object]) -> Make:
    """What was made, and a file of it replaced."""

    def both(room: Room) -> list[object]:
        arguments = make(room)
        change(room)
        return arguments

    return both


def _map_at_1e300(room: Room) -> list[object]:
    points = room.file("map.csv", b"x,y,z\n1e300,-1e300,1e300\n")
    return with_right_cloud("--map", points)(room)


HERE = np.eye(4).tolist()

ATTACKS = attacks(
    refused={
        "cloud_a_tenth_at_1e6": cloud(
            lambda points, rng: np.concatenate([points, points[::9] * 1e4])
        ),
        "cloud_on_a_line_with_strays": cloud(
            lambda points, rng: np.concatenate([_line(rng), points[:20]])
        ),
        "cloud_in_the_other_byte_order": cloud(
            lambda points, rng: points.astype("<f4").byteswap().view("<f4")
        ),
        "cloud_empty": cloud(lambda points, rng: points[:0]),
        "cloud_five_points": cloud(lambda points, rng: points[:5]),
        "cloud_one_point_5000_times": cloud(lambda points, rng: np.repeat(points[:1], 5000, 0)),
        "cloud_all_nan": cloud(lambda points, rng: points * np.nan),
        "cloud_behind_the_camera": cloud(lambda points, rng: -points),
        "cloud_metres": cloud(lambda points, rng: points / 1000),
        "cloud_kilometres_away": cloud(lambda points, rng: points + [0, 0, 1e6]),
        "cloud_on_a_line": cloud(lambda points, rng: _line(rng)),
        "cloud_on_a_table": cloud(
            lambda points, rng: np.insert(rng.uniform(-60, 60, (5000, 2)), 2, 130.0, axis=1)
        ),
        "ply_without_end": _ply_head("ascii", 3, "property float x"),
        "ply_of_a_billion": _ply_head("binary_little_endian", 10**9),
        "ply_of_words": _ply_head(
            *("ascii", 1, "property float x", "property float y", "property float z"),
            *("end_header", "one two three"),
        ),
        "ply_endless_header": file(lambda: b"ply\ncomment " + b"x" * 3_000_000),
        "ply_count_is_a_word": _ply_head("ascii", "many", "end_header"),
        "ply_count_of_400_digits": _ply_head("ascii", "9" * 400, "end_header"),
        "pcd_of_two_billion": file(lambda: pcd(count=2**31), "in.pcd"),
        "pcd_viewpoint_of_words": _pcd_from("a b c"),
        "pcd_from_another_viewpoint": _pcd_from("100 0 0 0 1 0 0"),
        "npz_pickle": file(lambda: npz(points_mm=np.array([{}], object)), "in.npz"),
        "npy_pickle": file(lambda: npy(np.array([{}], object)), "in.npy"),
        "npy_of_words": file(lambda: npy(np.array([["a", "b", "c"]])), "in.npy"),
        "npy_cut_off": file(lambda: npy(np.ones((500, 3)))[:200], "in.npy"),
        "npy_of_numbers_beyond_float": file(lambda: npy(np.full((500, 3), 1e300)), "in.npy"),
        "exr": file(lambda: b"\x76\x2f\x31\x01" + bytes(100), "in.exr"),
        "npz_bomb": file(_npz_bomb, "in.npz"),
        "npz_without_points": file(lambda: npz(other=np.zeros(3)), "in.npz"),
        "cloud_is_a_fifo": lambda room: [
            *("locate", room.base / "model", room.fifo("in.ply"), room.out)
        ],
        "cloud_without_end": lambda room: [
            *("locate", room.base / "model", room.endless("in.ply"), room.out)
        ],
        "cloud_name_of_300_bytes": lambda room: [
            *("locate", room.base / "model", "x" * 300 + ".ply", room.out)
        ],
        "model_name_of_300_bytes": lambda room: ["locate", "x" * 300, room.cloud, room.out],
        "intrinsics_1e308": depth(fx=1e308),
        "intrinsics_nan": depth(fx=float("nan")),
        "intrinsics_zero": depth(fx=0),
        "intrinsics_negative_width": depth(width=-848),
        "intrinsics_words": depth(fx="wide"),
        "intrinsics_of_another_size": depth(width=640),
        "intrinsics_infinite_unit": depth(depth_unit_mm=1e300),
        "intrinsics_focal_length_tenfold": depth(fx=6000.0, fy=6000.0),
        "intrinsics_axis_far_away": depth(cx=1e6),
        "intrinsics_nested": depth(text="[" * 100_000),
        "intrinsics_a_list": depth(text="[1, 2, 3]"),
        "intrinsics_are_a_fifo": _then(depth(), lambda room: room.fifo("intrinsics.json")),
        "intrinsics_without_end": _then(depth(), lambda room: room.endless("intrinsics.json")),
        "depth_of_8_bits": _image(848, 480, 8, lambda: bytes(849) * 480),
        "depth_claims_gigapixels": _image(60000, 60000, 16, lambda: bytes(10_000_000)),
        "depth_cut_short": depth(lambda png: png[: len(png) // 2]),
        "depth_all_zero": _image(848, 480, 16, lambda: bytes(1 + 2 * 848) * 480),
        "map_is_a_fifo": lambda room: with_right_cloud("--map", room.fifo("map.csv"))(room),
        "map_at_1e300": _map_at_1e300,
        "seed_of_100_bits": with_right_cloud("--seed", 10**30),
        "poses_of_one_view": views(HERE),
        "poses_nested": views(*[[[HERE]]] * 2),
        "poses_mirrored": views(HERE, np.diag([1.0, 1, -1, 1]).tolist()),
        "poses_at_1e300": views(HERE, [*HERE[:2], [0, 0, 1, 1e300], [0, 0, 0, 1]]),
        "poses_100_m_away": views(HERE, [[1, 0, 0, 1e5], *HERE[1:]]),
        "poses_nan": views(HERE, [[float("nan")] * 4] * 4),
        "poses_are_a_fifo": _then(views(HERE, HERE), lambda room: room.fifo("poses.json")),
    },
    either={
        "cloud_one_point_at_1e30": _one(5, 1e30),  # dropped, with a note
        "cloud_one_point_at_1e12": _one((5, 0), 1e12),
        "cloud_of_a_ball": cloud(_ball_surface),
        "cloud_mirrored": cloud(lambda points, rng: points * [-1, 1, 1]),
        "cloud_seen_from_behind": _about(lambda points: points * [1, -1, -1]),
        "cloud_of_noise": cloud(
            lambda points, rng: points.mean(0) + rng.uniform(-50, 50, (5000, 3))
        ),
        "cloud_stretched_twice": _about(lambda points: points * [2, 2, 1]),
        "poses_from_behind": views(HERE, np.diag([1.0, -1, -1, 1]).tolist()),
    },
)
