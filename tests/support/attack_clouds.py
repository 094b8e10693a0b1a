"""Hostile input: clouds, depth images and intrinsics."""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from attack_registry import ATTACKS, FINISH, Attack, Made, attack


def ply(points: np.ndarray, head: str = "") -> bytes:
    return (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{head}"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    ).encode() + points.astype("<f4").tobytes()


def locate(folder: Path, base: Path, content: np.ndarray | bytes, name: str = "in.ply") -> Made:
    (folder / name).write_bytes(content if isinstance(content, bytes) else ply(content))
    return ["locate", base / "model", folder / name, folder / "out", "--device", "cpu"]


def seen(base: Path) -> np.ndarray:
    """A right cloud of the model's organ."""
    from tumortrack.sense.files import read_cloud

    return np.array(read_cloud(base / "scenes" / "0000" / "cloud.ply")[0].points_mm)


def cloud_of(make: Callable[[np.ndarray, np.random.Generator], Any]) -> Attack:
    return lambda folder, base: locate(
        folder, base, np.asarray(make(seen(base), np.random.default_rng(0)))
    )


def _ball_surface(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return (points.mean(0) + 35 * direction)[direction[:, 2] < 0]


def _one_at_1e30(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    points[5] = 1e30
    return points


def _one_at_1e12(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    points[5, 0] = 1e12
    return points


def _flat(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.column_stack([rng.uniform(-60, 60, (5000, 2)), np.full(5000, 130.0)])


ATTACKS |= {
    "cloud_one_point_at_1e30": cloud_of(_one_at_1e30),
    "cloud_one_point_at_1e12": cloud_of(_one_at_1e12),
    "cloud_a_tenth_at_1e6": cloud_of(
        lambda points, rng: np.concatenate([points, points[::9] * 1e4])
    ),
    "cloud_on_a_line_with_strays": cloud_of(
        lambda points, rng: np.concatenate(
            [np.outer(rng.uniform(0, 100, 5000), [0.9, 0.1, 0]) + [0, 0, 130], points[:20]]
        )
    ),
    "cloud_in_the_other_byte_order": cloud_of(
        lambda points, rng: points.astype("<f4").byteswap().view("<f4")
    ),
    "cloud_empty": cloud_of(lambda points, rng: points[:0]),
    "cloud_five_points": cloud_of(lambda points, rng: points[:5]),
    "cloud_one_point_5000_times": cloud_of(lambda points, rng: np.repeat(points[:1], 5000, 0)),
    "cloud_all_nan": cloud_of(lambda points, rng: points * np.nan),
    "cloud_behind_the_camera": cloud_of(lambda points, rng: -points),
    "cloud_metres": cloud_of(lambda points, rng: points / 1000),
    "cloud_kilometres_away": cloud_of(lambda points, rng: points + [0, 0, 1e6]),
    "cloud_on_a_line": cloud_of(
        lambda points, rng: np.outer(rng.uniform(0, 100, 5000), [0.9, 0.1, 0]) + [0, 0, 130]
    ),
    "cloud_on_a_table": cloud_of(_flat),
    "cloud_of_a_ball": cloud_of(_ball_surface),
    "cloud_mirrored": cloud_of(lambda points, rng: points * [-1, 1, 1]),
    "cloud_seen_from_behind": cloud_of(
        lambda points, rng: (points - points.mean(0)) * [1, -1, -1] + points.mean(0)
    ),
    "cloud_of_noise": cloud_of(
        lambda points, rng: points.mean(0) + rng.uniform(-50, 50, (5000, 3))
    ),
    "cloud_stretched_twice": cloud_of(
        lambda points, rng: (points - points.mean(0)) * [2, 2, 1] + points.mean(0)
    ),
}
FINISH |= {
    "cloud_of_a_ball",
    "cloud_mirrored",
    "cloud_seen_from_behind",
    "cloud_of_noise",
    "cloud_stretched_twice",
    "cloud_one_point_at_1e30",  # dropped, with a note
    "cloud_one_point_at_1e12",
    "model_of_endless_points",  # of depth images only, which have fewer
}


for name, head in (
    ("ply_without_end", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n"),
    ("ply_of_a_billion", "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\n"),
    ("ply_of_words", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
     "property float z\nend_header\none two three\n"),
    ("ply_endless_header", "ply\ncomment " + "x" * 3_000_000),
    ("ply_count_is_a_word", "ply\nformat ascii 1.0\nelement vertex many\nend_header\n"),
    ("ply_count_of_400_digits", f"ply\nformat ascii 1.0\nelement vertex {'9' * 400}\nend_header\n"),
):  # fmt: skip
    ATTACKS[name] = lambda folder, base, h=head: locate(folder, base, h.encode())


def pcd(viewpoint: str = "0 0 0 1 0 0 0", count: int = 3) -> bytes:
    return (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH "
        f"{count}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {count}\nDATA binary\n"
    ).encode()


@attack
def _pcd_of_two_billion(folder: Path, base: Path) -> Made:
    return locate(folder, base, pcd(count=2**31), "in.pcd")


@attack
def _pcd_viewpoint_of_words(folder: Path, base: Path) -> Made:
    points = seen(base)
    content = pcd("a b c", len(points)) + points.astype("<f4").tobytes()
    return locate(folder, base, content, "in.pcd")


@attack
def _pcd_from_another_viewpoint(folder: Path, base: Path) -> Made:
    points = seen(base)
    content = pcd("100 0 0 0 1 0 0", len(points)) + points.astype("<f4").tobytes()
    return locate(folder, base, content, "in.pcd")


def npz(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


@attack
def _npz_pickle(folder: Path, base: Path) -> Made:
    return locate(folder, base, npz(points_mm=np.array([{}], object)), "in.npz")


@attack
def _npz_bomb(folder: Path, base: Path) -> Made:
    """2 MB that unpack to 2.4 GB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f4", "fortran_order": False, "shape": (200_000_000, 3)}
    )
    import zipfile

    with zipfile.ZipFile(folder / "in.npz", "w", zipfile.ZIP_DEFLATED) as archive:  # noqa: SIM117
        with archive.open("points_mm.npy", "w", force_zip64=True) as stream:
            stream.write(head.getvalue())
            for _ in range(2400):
                stream.write(bytes(1_000_000))
    return ["locate", base / "model", folder / "in.npz", folder / "out", "--device", "cpu"]


@attack
def _npz_without_points(folder: Path, base: Path) -> Made:
    return locate(folder, base, npz(other=np.zeros(3)), "in.npz")


@attack
def _cloud_is_a_fifo(folder: Path, base: Path) -> Made:
    os.mkfifo(folder / "in.ply")
    return ["locate", base / "model", folder / "in.ply", folder / "out"]


@attack
def _cloud_without_end(folder: Path, base: Path) -> Made:
    (folder / "in.ply").symlink_to("/dev/zero")
    return ["locate", base / "model", folder / "in.ply", folder / "out"]


def depth(folder: Path, base: Path, intrinsics: object = None, png: bytes | None = None) -> Made:
    scene = base / "scenes" / "0000"
    given = json.loads((scene / "intrinsics.json").read_text())
    if isinstance(intrinsics, dict):
        given |= intrinsics
    text = intrinsics if isinstance(intrinsics, str) else json.dumps(given)
    (folder / "intrinsics.json").write_text(text)
    (folder / "in.png").write_bytes((scene / "depth.png").read_bytes() if png is None else png)
    options = ["--intrinsics", folder / "intrinsics.json", "--device", "cpu"]
    return ["locate", base / "model", folder / "in.png", folder / "out", *options]


for name, change in (
    ("intrinsics_1e308", {"fx": 1e308}),
    ("intrinsics_nan", {"fx": float("nan")}),
    ("intrinsics_zero", {"fx": 0}),
    ("intrinsics_negative_width", {"width": -848}),
    ("intrinsics_words", {"fx": "wide"}),
    ("intrinsics_of_another_size", {"width": 640}),
    ("intrinsics_infinite_unit", {"depth_unit_mm": 1e300}),
    ("intrinsics_focal_length_tenfold", {"fx": 6000.0, "fy": 6000.0}),
    ("intrinsics_axis_far_away", {"cx": 1e6}),
    ("intrinsics_nested", "[" * 100_000),
    ("intrinsics_a_list", "[1, 2, 3]"),
):
    ATTACKS[name] = lambda folder, base, c=change: depth(folder, base, c)


@attack
def _intrinsics_are_a_fifo(folder: Path, base: Path) -> Made:
    made = depth(folder, base)
    (folder / "intrinsics.json").unlink()
    os.mkfifo(folder / "intrinsics.json")
    return made


@attack
def _intrinsics_without_end(folder: Path, base: Path) -> Made:
    made = depth(folder, base)
    (folder / "intrinsics.json").unlink()
    (folder / "intrinsics.json").symlink_to("/dev/zero")
    return made


@attack
def _map_is_a_fifo(folder: Path, base: Path) -> Made:
    os.mkfifo(folder / "map.csv")
    cloud = base / "scenes" / "0000" / "cloud.ply"
    return ["locate", base / "model", cloud, folder / "out", "--map", folder / "map.csv"]


@attack
def _map_at_1e300(folder: Path, base: Path) -> Made:
    (folder / "map.csv").write_text("x,y,z\n1e300,-1e300,1e300\n")
    cloud = base / "scenes" / "0000" / "cloud.ply"
    return ["locate", base / "model", cloud, folder / "out", "--map", folder / "map.csv"]


@attack
def _seed_of_100_bits(folder: Path, base: Path) -> Made:
    cloud = base / "scenes" / "0000" / "cloud.ply"
    return ["locate", base / "model", cloud, folder / "out", "--seed", 10**30]


def views(folder: Path, base: Path, *poses: object, **changed: object) -> Made:
    """Two views of a right cloud, from such places."""
    cloud = base / "scenes" / "0000" / "cloud.ply"
    given = {"fixed_from_camera": poses, "unit": "mm", "frame_id": "base_link"} | changed
    (folder / "poses.json").write_text(json.dumps(given))
    options = ["--poses", folder / "poses.json", "--device", "cpu"]
    return ["locate", base / "model", cloud, cloud, folder / "out", *options]


HERE = np.eye(4).tolist()
for name, poses in (
    ("poses_of_one_view", [HERE]),
    ("poses_nested", [[[HERE]]] * 2),
    ("poses_mirrored", [HERE, np.diag([1.0, 1, -1, 1]).tolist()]),
    ("poses_at_1e300", [HERE, [*HERE[:2], [0, 0, 1, 1e300], [0, 0, 0, 1]]]),
    ("poses_100_m_away", [HERE, [[1, 0, 0, 1e5], *HERE[1:]]]),
    ("poses_nan", [HERE, [[float("nan")] * 4] * 4]),
    ("poses_from_behind", [HERE, np.diag([1.0, -1, -1, 1]).tolist()]),
):
    ATTACKS[name] = lambda folder, base, p=poses: views(folder, base, *p)
FINISH.add("poses_from_behind")


@attack
def _poses_are_a_fifo(folder: Path, base: Path) -> Made:
    made = views(folder, base, HERE, HERE)
    (folder / "poses.json").unlink()
    os.mkfifo(folder / "poses.json")
    return made


def png_of(width: int, height: int, bits: int, data: bytes) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@attack
def _depth_of_8_bits(folder: Path, base: Path) -> Made:
    rows = bytes(849) * 480
    return depth(folder, base, png=png_of(848, 480, 8, zlib.compress(rows)))


@attack
def _depth_claims_gigapixels(folder: Path, base: Path) -> Made:
    return depth(folder, base, png=png_of(60000, 60000, 16, zlib.compress(bytes(10_000_000))))


@attack
def _depth_cut_short(folder: Path, base: Path) -> Made:
    whole = (base / "scenes" / "0000" / "depth.png").read_bytes()
    return depth(folder, base, png=whole[: len(whole) // 2])


@attack
def _depth_all_zero(folder: Path, base: Path) -> Made:
    rows = bytes(1 + 2 * 848) * 480
    return depth(folder, base, png=png_of(848, 480, 16, zlib.compress(rows)))
