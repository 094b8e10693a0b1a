"""Hostile input: models, plans and runs whose files were changed and sealed again, recordings, and
tables of tools."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hostile import CPU, NAN, Make, Room, attacks, check

Change = Callable[[Path], object]  # of a folder's files


@pytest.fixture
def room(tmp_path, monkeypatch, attack_base):
    monkeypatch.chdir(tmp_path)
    return Room(tmp_path, attack_base)


def resealed(room: Room, kind: str, change: Change) -> Path:
    """A copy of an artifact whose files were changed and whose manifest says so."""
    from tumortrack.core import store

    copy = room.folder / "changed"
    shutil.copytree(room.base / kind, copy)
    change(copy)
    manifest = json.loads((copy / store.MANIFEST).read_text())
    for name in manifest["files"]:
        manifest["files"][name] = store.sha256_of(copy / name)
    (copy / store.MANIFEST).write_text(json.dumps(manifest))
    return copy


def model(change: Change, then: Change = lambda model: None, kind: str = "model") -> Make:
    """`locate` with a changed model; ``then``: a change that its manifest does not know."""

    def make(room: Room) -> list[object]:
        changed = resealed(room, kind, change)
        then(changed)
        return ["locate", changed, room.cloud, "--out", room.out, *CPU]

    return make


def plan(change: Change) -> Make:
    """`resect` of a changed plan."""
    return lambda room: [
        *("resect", resealed(room, "plan", change), "--speed", 20),
        *("--report", room.folder / "report.json"),
    ]


def json_of(name: str, change: Callable[[Any], Any]) -> Change:
    """A JSON file becomes another."""

    def edit(folder: Path) -> None:
        data = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(change(data)))

    return edit


def manifest(**changes: object) -> Change:
    return json_of("manifest.json", lambda whole: whole | changes)


def within(*keys: str, value: object) -> Change:
    """One entry of the manifest."""

    def put(whole: Any) -> Any:
        inner = whole
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        return whole

    return json_of("manifest.json", put)


def file(name: str, change: Callable[[bytes], bytes]) -> Change:
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def tensors(name: str, change: Callable[[str, np.ndarray], np.ndarray]) -> Change:
    def edit(folder: Path) -> None:
        from safetensors import safe_open
        from safetensors.numpy import load_file, save_file

        with safe_open(folder / name, "np") as stream:
            metadata = stream.metadata()
        arrays = {key: change(key, value.copy()) for key, value in load_file(folder / name).items()}
        save_file(arrays, folder / name, metadata=metadata)

    return edit


def weights(fill: float) -> Make:
    change = tensors("weights.safetensors", lambda _, value: np.full_like(value, fill))
    return model(change, kind="network")


def shape(number: float) -> Make:
    """The first five numbers of each tensor."""

    def change(_: str, value: np.ndarray) -> np.ndarray:
        if value.dtype.kind == "f":
            value.reshape(-1)[:5] = number
        return value

    return model(tensors("shape.safetensors", change))


def nothing(_: Path) -> None:
    pass


cut = file("shape.safetensors", lambda content: content[:5000])


def case_with_a_damaged_model(room: Room) -> list[object]:
    """The model in the case was cut short after it was made."""
    case = room.folder / "case"
    shutil.copytree(room.base / "case", case, ignore=shutil.ignore_patterns("model"))
    shutil.copytree(room.base / "model", case / "model")
    cut(case / "model")
    return ["locate", case, room.cloud, "--out", room.out]


def surer(value: Any) -> Any:
    """A model that is said to be a million times as sure of itself."""
    if not isinstance(value, dict):
        return value
    return {key: 1e-6 if key == "std_scale" else surer(inner) for key, inner in value.items()}


@attacks(
    refused={
        "weights_nan": weights(NAN),
        "weights_1e30": weights(1e30),
        "weights_minus_1e3": weights(-1e3),
        "weights_header_of_2_60": model(
            file("weights.safetensors", lambda content: struct.pack("<Q", 2**60) + b"{}"),
            kind="network",
        ),
        "box_nan": model(manifest(query_box_mm=[[NAN] * 3, [1.0] * 3]), kind="network"),
        "box_of_a_kilometre": model(manifest(query_box_mm=[[-1e6] * 3, [1e6] * 3]), kind="network"),
        "of_endless_width": model(
            within("config", "network", "decoder", "width", value=3 * 10**4), kind="network"
        ),
        "shape_nan": shape(NAN),
        "shape_1e30": shape(1e30),
        "shape_cut": model(cut),
        "parts_swapped": model(manifest(parts=["tumor_1", "kidney", "tumor_2"])),
        "of_endless_parts": model(manifest(parts=[f"tumor_{n}" for n in range(10**5)])),
        "of_endless_steps": model(within("config", "refine", "steps", value=10**12)),
        "of_endless_tilts": model(within("config", "scene", "pose", "tilt_deg", value=1e300)),
        "of_schema_999": model(manifest(schema=999)),
        "config_null": model(manifest(config=None)),
        "up_nan": model(within("provenance", "up_lps", value=[NAN] * 3)),
        "names_a_file_outside": model(
            nothing, then=within("files", "../../etc/passwd", value="0" * 64)
        ),
        "manifest_nested": model(
            nothing, then=file("manifest.json", lambda content: b"[" * 1_000_000)
        ),
        "calibration_edited": model(nothing, then=json_of("manifest.json", surer)),
        "as_a_case": lambda room: ["export", room.base / "model", room.out],
        "damaged_in_a_case": case_with_a_damaged_model,
    },
    either={  # of depth images only, which have fewer
        "of_endless_points": model(within("config", "scene", "cloud", "n_points", value=10**10)),
    },
)
def test_models(make, end, room):
    check(make, end, room)


def motions(suffix: str, change: Callable[[np.ndarray], np.ndarray]) -> Make:
    """A plan whose motions' tensors of such names are others."""

    def changed(name: str, value: np.ndarray) -> np.ndarray:
        return change(value) if name.endswith(suffix) else value

    return plan(tensors("motions.safetensors", changed))


def joint(off_rad: float) -> Make:
    def change(joints_rad: np.ndarray) -> np.ndarray:
        joints_rad[10, 3] += off_rad
        return joints_rad

    return motions("1.joints_rad", change)


def without(name: str) -> Make:
    """A file that the manifest does not know of either."""

    def remove(folder: Path) -> None:
        (folder / name).unlink()
        manifest_without = {
            n: 0 for n in json.loads((folder / "manifest.json").read_text())["files"]
        }
        del manifest_without[name]
        manifest(files=manifest_without)(folder)

    return plan(remove)


def nearer_tumor(folder: Path) -> None:
    """The tumor that is cut out lies 2 mm nearer to the first facet."""
    from tumortrack.io.mesh_files import read_mesh, write_mesh

    planned = json.loads((folder / "plan.json").read_text())["plan"]
    path = folder / f"{planned['tumor']}.ply"
    mesh = read_mesh(path)
    write_mesh(path, mesh.with_vertices(mesh.vertices_mm + 2 * np.array(planned["facets"][0][:3])))


def points_at_nan(content: bytes) -> bytes:
    start = content.index(b"end_header") + 11
    return content[:start] + struct.pack("<f", NAN) * 3 + content[start + 12 :]


@attacks(
    refused={
        "motions_nan": joint(NAN),
        "motions_off_by_3_rad": joint(3.0),
        "motions_times_1e300": motions("times_s", lambda times_s: times_s * 1e300),
        "motions_times_backwards": motions("times_s", lambda times_s: -times_s),
        "motions_ten_times_too_fast": motions("times_s", lambda times_s: 0.1 * times_s),
        "motions_of_no_length": motions("", lambda value: value[:0]),
        "of_a_nearer_tumor": plan(nearer_tumor),
        "in_another_cell": plan(
            file("cell.urdf", lambda text: text.replace(b'radius="0.0012"', b'radius="0.0002"'))
        ),
        "without_its_cell": without("cell.urdf"),
        "without_its_piece": without("piece.ply"),
        "without_budgets": plan(json_of("plan.json", lambda data: data | {"budgets": []})),
        "that_keeps_nan": plan(
            json_of("plan.json", lambda data: data | {"plan": data["plan"] | {"margin_mm": NAN}})
        ),
        "of_another_schema": plan(manifest(schema=7)),
        # A stored plan that nothing looks at must move no real arm.
        "real_arm_without_live": lambda room: [
            *("resect", room.base / "plan", "ur:127.0.0.1?execute=true"),
            *("--report", room.folder / "report.json"),
        ],
        "run_with_points_at_nan": lambda room: [
            *("plan", resealed(room, "run", file("occupancy.ply", points_at_nan))),
            *(room.out, "--no-arms"),
        ],
    },
)
def test_plans(make, end, room):
    check(make, end, room)


def track(source: Callable[[Room], object], *more: Callable[[Room], object] | str) -> Make:
    def make(room: Room) -> list[object]:
        options = [each if isinstance(each, str) else each(room) for each in more]
        return [
            *("track", room.base / "model", f"recording:{source(room)}", *CPU, "--give-up", 3),
            *("--report", room.folder / "report.json", *options),
        ]

    return make


def recording(name: str, content: bytes) -> Make:
    return track(lambda room: room.file(name, content))


def tool(content: str | bytes) -> Make:
    """`track` with a table of a tool's poses."""
    frame = {"frame_id": "base", "unit": "mm", "robot_from_camera": np.eye(4).tolist()}
    table = content.encode() if isinstance(content, str) else content
    return track(
        lambda room: room.file("in.mcap", b""),
        *("--tool", lambda room: f"probe=file:{room.file('tool.csv', table)}"),
        *("--frame", lambda room: room.file("base.json", json.dumps(frame).encode())),
    )


def folder_of_nothing(room: Room) -> Path:
    (room.folder / "frames").mkdir()
    return room.folder / "frames"


GARBAGE = bytes(range(256)) * 400
POSES = "stamp_ns,x_mm,y_mm,z_mm,qx,qy,qz,qw,frame_id,contact\n"


@attacks(
    refused={
        "mcap_of_garbage": recording("in.mcap", b"\x89MCAP0\r\n" + GARBAGE),
        "mcap_cut": recording("in.mcap", b"\x89MCAP0\r\n"),
        "db3_of_garbage": recording("in.db3", b"SQLite format 3\0" + GARBAGE),
        "bag_of_garbage": recording("in.bag", b"#ROSBAG V2.0\n" + GARBAGE),
        "empty": recording("in.mcap", b""),
        "folder_of_nothing": track(folder_of_nothing),
        "name_of_300_bytes": track(lambda room: "x" * 300),
        "tool_of_no_poses": tool(POSES),
        "tool_of_words": tool(POSES + "now,a,b,c,d,e,f,g,base,yes\n"),
        "tool_is_a_picture": tool(b"\x89PNG\r\n\x1a\n" + bytes(1000)),
    },
)
def test_recordings_and_tools(make, end, room):
    check(make, end, room)
