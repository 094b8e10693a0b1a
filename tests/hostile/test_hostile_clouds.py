"""Hostile input of `locate`: clouds, depth images, intrinsics, poses of views, evidence."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hostile import CPU, Make, Room, attacks, check
from raw_files import npy, npz, pcd, ply, png


@pytest.fixture
def room(tmp_path, monkeypatch, attack_base):
    monkeypatch.chdir(tmp_path)
    return Room(tmp_path, attack_base)


def with_model(*arguments: Any) -> Make:
    """`locate` with a right model; arguments that are functions are called with the room."""

    def make(room: Room) -> list[object]:
        views, *options = (each(room) if callable(each) else each for each in arguments)
        return ["locate", room.base / "model", views, "--out", room.out, *options, *CPU]

    return make


def file(content: Callable[[], bytes], name: str = "in.ply") -> Make:
    return with_model(lambda room: room.file(name, content()))


def cloud(change: Callable[[np.ndarray, np.random.Generator], Any]) -> Make:
    """A right cloud that was changed."""
    from tumortrack.io.depth_files import read_cloud

    def changed(room: Room) -> object:
        points = np.array(read_cloud(room.cloud)[0].points_mm)
        return room.file("in.ply", ply(np.asarray(change(points, np.random.default_rng(0)))))

    return with_model(changed)


def option(name: str, value: Callable[[Room], object]) -> Make:
    """A right cloud and an option."""
    return with_model(lambda room: room.cloud, name, value)


def about_its_middle(factors: list[float]) -> Make:
    return cloud(lambda points, rng: (points - points.mean(0)) * factors + points.mean(0))


def one(where: object, value: float) -> Make:
    def change(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        points[where] = value
        return points

    return cloud(change)


def line(rng: np.random.Generator) -> np.ndarray:
    return np.outer(rng.uniform(0, 100, 5000), [0.9, 0.1, 0]) + [0, 0, 130]


def ball_surface(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return (points.mean(0) + 35 * direction)[direction[:, 2] < 0]


def ply_head(kind: str, count: object, *more: str) -> Make:
    text = ["ply", f"format {kind} 1.0", f"element vertex {count}", *more, ""]
    return file(lambda: "\n".join(text).encode())


def npz_bomb() -> bytes:
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


@attacks(
    refused={
        "a_tenth_at_1e6": cloud(lambda points, rng: np.concatenate([points, points[::9] * 1e4])),
        "on_a_line_with_strays": cloud(
            lambda points, rng: np.concatenate([line(rng), points[:20]])
        ),
        "in_the_other_byte_order": cloud(
            lambda points, rng: points.astype("<f4").byteswap().view("<f4")
        ),
        "five_points": cloud(lambda points, rng: points[:5]),
        "one_point_5000_times": cloud(lambda points, rng: np.repeat(points[:1], 5000, 0)),
        "all_nan": cloud(lambda points, rng: points * np.nan),
        "behind_the_camera": cloud(lambda points, rng: -points),
        "metres": cloud(lambda points, rng: points / 1000),
        "kilometres_away": cloud(lambda points, rng: points + [0, 0, 1e6]),
        "on_a_line": cloud(lambda points, rng: line(rng)),
        "on_a_table": cloud(
            lambda points, rng: np.insert(rng.uniform(-60, 60, (5000, 2)), 2, 130.0, axis=1)
        ),
        "ply_of_a_billion": ply_head("binary_little_endian", 10**9),
        "ply_endless_header": file(lambda: b"ply\ncomment " + b"x" * 3_000_000),
        "ply_count_of_400_digits": ply_head("ascii", "9" * 400, "end_header"),
        "pcd_of_two_billion": file(lambda: pcd(count=2**31), "in.pcd"),
        "pcd_from_another_viewpoint": file(
            lambda: pcd("100 0 0 0 1 0 0", 500) + bytes(500 * 12), "in.pcd"
        ),
        "npz_pickle": file(lambda: npz(points_mm=np.array([{}], object)), "in.npz"),
        "npy_pickle": file(lambda: npy(np.array([{}], object)), "in.npy"),
        "npy_of_numbers_beyond_float": file(lambda: npy(np.full((500, 3), 1e300)), "in.npy"),
        "npz_bomb": file(npz_bomb, "in.npz"),
        "is_a_fifo": with_model(lambda room: room.fifo("in.ply")),
        "without_end": with_model(lambda room: room.endless("in.ply")),
        "name_of_300_bytes": with_model("x" * 300 + ".ply"),
        "model_name_of_300_bytes": lambda room: [
            "locate",
            "x" * 300,
            room.cloud,
            "--out",
            room.out,
        ],
        "map_is_a_fifo": option("--map", lambda room: room.fifo("map.csv")),
        "map_at_1e300": option("--map", lambda room: room.file("map.csv", b"x,y,z\n1e300,0,0\n")),
        "seed_of_100_bits": option("--seed", lambda room: 10**30),
    },
    either={
        "one_point_at_1e30": one(5, 1e30),  # dropped, with a note
        "one_point_at_1e12": one((5, 0), 1e12),
        "of_a_ball": cloud(ball_surface),
        "mirrored": cloud(lambda points, rng: points * [-1, 1, 1]),
        "seen_from_behind": about_its_middle([1, -1, -1]),
        "of_noise": cloud(lambda points, rng: points.mean(0) + rng.uniform(-50, 50, (5000, 3))),
        "stretched_twice": about_its_middle([2, 2, 1]),
    },
)
def test_clouds(make, end, room):
    check(make, end, room)


def depth(change: Callable[[bytes], bytes] = bytes, text: str = "", **intrinsics: object) -> Make:
    """A right depth image with changed pixels, or other intrinsics."""

    def written(room: Room) -> object:
        given = json.loads(room.cloud.with_name("intrinsics.json").read_text()) | intrinsics
        return room.file("intrinsics.json", (text or json.dumps(given)).encode())

    def image(room: Room) -> object:
        return room.file("in.png", change(room.cloud.with_name("depth.png").read_bytes()))

    return with_model(image, "--intrinsics", written)


def special(make: Make, kind: str, name: str) -> Make:
    """What was made, and then a file of it is a FIFO, or endless."""

    def both(room: Room) -> list[object]:
        arguments = make(room)
        getattr(room, kind)(name)
        return arguments

    return both


def views(*poses: object) -> Make:
    """Two views of a right cloud, from such places."""

    def make(room: Room) -> list[object]:
        given = {"fixed_from_camera": poses, "unit": "mm", "frame_id": "base_link"}
        written = room.file("poses.json", json.dumps(given).encode())
        clouds = (room.cloud, room.cloud)
        return ["locate", room.base / "model", *clouds, "--out", room.out, "--poses", written, *CPU]

    return make


IDENTITY = np.eye(4).tolist()


@attacks(
    refused={
        "intrinsics_1e308": depth(fx=1e308),
        "intrinsics_infinite_unit": depth(depth_unit_mm=1e300),
        "intrinsics_focal_length_tenfold": depth(fx=6000.0, fy=6000.0),
        "intrinsics_axis_far_away": depth(cx=1e6),
        "intrinsics_nested": depth(text="[" * 100_000),
        "intrinsics_are_a_fifo": special(depth(), "fifo", "intrinsics.json"),
        "intrinsics_without_end": special(depth(), "endless", "intrinsics.json"),
        "depth_of_8_bits": depth(lambda _: png(848, 480, 8, bytes(849) * 480)),
        "depth_claims_gigapixels": depth(lambda _: png(60000, 60000, 16, bytes(10_000_000))),
        "depth_all_zero": depth(lambda _: png(848, 480, 16, bytes(1 + 2 * 848) * 480)),
        "poses_of_one_view": views(IDENTITY),
        "poses_mirrored": views(IDENTITY, np.diag([1.0, 1, -1, 1]).tolist()),
        "poses_at_1e300": views(IDENTITY, [*IDENTITY[:2], [0, 0, 1, 1e300], [0, 0, 0, 1]]),
        "poses_100_m_away": views(IDENTITY, [[1, 0, 0, 1e5], *IDENTITY[1:]]),
        "poses_are_a_fifo": special(views(IDENTITY, IDENTITY), "fifo", "poses.json"),
    },
    either={"poses_from_behind": views(IDENTITY, np.diag([1.0, -1, -1, 1]).tolist())},
)
def test_depth_images_and_views(make, end, room):
    check(make, end, room)


TOUCH: dict[str, Any] = {"kind": "touch", "place_mm": [0.0, 0.0, 150.0]}
HEADER = "piece,frame,kind,x_mm,y_mm,z_mm\n"


def evidence(content: bytes, name: str = "evidence.json") -> Make:
    return option("--evidence", lambda room: room.file(name, content))


def pieces_of(*pieces: object, **changes: object) -> bytes:
    given = {"frame": "camera", "unit": "mm", "evidence": pieces, **changes}
    return json.dumps(given).encode()


def told(*pieces: object, **changes: object) -> Make:
    return evidence(pieces_of(*pieces, **changes))


def touch(**changes: object) -> Make:
    return told({**TOUCH, **changes})


def table(text: str) -> Make:
    return evidence((HEADER + text).encode(), "evidence.csv")


def alone(*places: tuple[float, float, float]) -> Make:
    """Touches in place of a cloud."""
    content = pieces_of(*({**TOUCH, "place_mm": place} for place in places))
    return with_model("-", "--evidence", lambda room: room.file("evidence.json", content))


@attacks(
    refused={
        "empty": evidence(b""),
        "a_pickle": evidence(b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x02os"),
        "nested": evidence(b"[" * 1_000_000),
        "of_20_mb": told(*[TOUCH] * 400_000),
        "is_a_fifo": option("--evidence", lambda room: room.fifo("e.json")),
        "without_end": option("--evidence", lambda room: room.endless("e.json")),
        "table_without_end": option("--evidence", lambda room: room.endless("e.csv")),
        "sure_to_nothing": touch(std_mm=1e-300),
        "of_no_part": touch(part="../../etc/passwd"),
        "of_a_stamp_of_100_bits": touch(stamp_ns=10**30),
        "table_of_a_huge_cell": table("1,camera,touch," + "9" * 200_000 + ",0,0\n"),
        "of_5000_touches": told(*[TOUCH] * 5000),
        "outline_of_50000_places": told(
            {"kind": "outline", "part": "tumor_1", "places_mm": [[0, 0, 150.0]] * 50_000}
        ),
        "alone_in_one_place": alone(*[(0.0, 0.0, 150.0)] * 20),
        "alone_on_a_line": alone(*[(5.0 * n, 0.0, 150.0) for n in range(20)]),
        "alone_far_apart": alone(*[(90.0 * n, 60.0 * (n % 3), 150.0) for n in range(20)]),
    },
    either={
        "of_1000_touches": told(*[TOUCH] * 1000),
        "a_metre_off": touch(place_mm=[900.0, 0.0, 900.0]),
        "all_is_free": told(
            {
                "kind": "free_space",
                "places_mm": [[x, y, 150.0] for x in range(30) for y in range(30)],
            }
        ),
        "of_one_place_50_times_sure": told(*[{**TOUCH, "std_mm": 0.05}] * 50),
    },
)
def test_evidence(make, end, room):
    check(make, end, room)
