"""Hostile input: models, plans and runs whose files were changed, and recordings."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from attack import Make, Room, attacks
from attack_clouds import CPU

Change = Callable[[Path], object]  # of a folder's files
NAN = float("nan")


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
        return ["locate", changed, room.cloud, room.out, *CPU]

    return make


def network(change: Change) -> Make:
    return model(change, kind="network")


def edited(change: Callable[[Any], Any]) -> Change:
    """A manifest, as JSON, becomes another."""

    def edit(artifact: Path) -> None:
        path = artifact / "manifest.json"
        path.write_text(json.dumps(change(json.loads(path.read_text()))))

    return edit


def manifest(**changes: object) -> Change:
    return edited(lambda whole: whole | changes)


def within(*keys: str, value: object) -> Change:
    """One entry of the manifest."""

    def put(whole: Any) -> Any:
        inner = whole
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        return whole

    return edited(put)


def file(name: str, change: Callable[[bytes], bytes]) -> Change:
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def tensors(name: str, change: Callable[[dict[str, np.ndarray]], object]) -> Change:
    def edit(folder: Path) -> None:
        from safetensors import safe_open
        from safetensors.numpy import load_file, save_file

        with safe_open(folder / name, "np") as stream:
            metadata = stream.metadata()
        arrays = load_file(folder / name)
        change(arrays)
        save_file(arrays, folder / name, metadata=metadata)

    return edit


def _weights(fill: float) -> Make:
    def change(arrays: dict[str, np.ndarray]) -> None:
        for name, value in arrays.items():
            arrays[name] = np.full_like(value, fill)

    return network(tensors("weights.safetensors", change))


def _shape(value: float) -> Make:
    """The first five numbers of each tensor."""

    def change(arrays: dict[str, np.ndarray]) -> None:
        for array in arrays.values():
            if array.dtype.kind == "f":
                array.reshape(-1)[:5] = value

    return model(tensors("shape.safetensors", change))


_cut = file("shape.safetensors", lambda content: content[:5000])


def _case_with_a_damaged_model(room: Room) -> list[object]:
    """The model in the case was cut short after it was made."""
    case = room.folder / "case"
    shutil.copytree(room.base / "case", case, ignore=shutil.ignore_patterns("model"))
    shutil.copytree(room.base / "model", case / "model")
    _cut(case / "model")
    return ["locate", case, room.cloud, room.out]


def _surer(value: Any) -> Any:
    """A model that is said to be a million times as sure of itself."""
    if not isinstance(value, dict):
        return value
    return {key: 1e-6 if key == "std_scale" else _surer(inner) for key, inner in value.items()}


def motions(change: Callable[[dict[str, np.ndarray]], object]) -> Make:
    def make(room: Room) -> list[object]:
        plan = resealed(room, "plan", tensors("motions.safetensors", change))
        return ["resect", plan, "--speed", 20, "--report", room.folder / "report.json"]

    return make


def plan(change: Change) -> Make:
    """`resect` of a plan whose other files were changed."""
    return lambda room: [
        *("resect", resealed(room, "plan", change), "--speed", 20),
        *("--report", room.folder / "report.json"),
    ]


def _plan_json(change: Callable[[dict[str, Any]], object]) -> Make:
    def edit(folder: Path) -> None:
        path = folder / "plan.json"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return plan(edit)


def _without(name: str) -> Make:
    """A file that the manifest does not know of either."""

    def remove(folder: Path) -> None:
        (folder / name).unlink()
        edited(lambda whole: whole | {"files": {n: 0 for n in whole["files"] if n != name}})(folder)

    return plan(remove)


def _nearer_tumor(folder: Path) -> None:
    """The tumor that is cut out lies 2 mm nearer to the first facet."""
    from tumortrack.core.mesh_files import read_mesh, write_mesh

    planned = json.loads((folder / "plan.json").read_text())["plan"]
    path = folder / f"{planned['tumor']}.ply"
    mesh = read_mesh(path)
    write_mesh(path, mesh.moved(mesh.vertices_mm + 2 * np.array(planned["facets"][0][:3])))


def _joint(value: float) -> Make:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays["1.joints_rad"] = arrays["1.joints_rad"].copy()
        arrays["1.joints_rad"][10, 3] += value

    return motions(change)


def _times(factor: float) -> Make:
    return motions(
        lambda arrays: arrays.update(
            {name: array * factor for name, array in arrays.items() if name.endswith("times_s")}
        )
    )


def _points_at_nan(content: bytes) -> bytes:
    start = content.index(b"end_header") + 11
    return content[:start] + struct.pack("<f", NAN) * 3 + content[start + 12 :]


def track(room: Room, source: object) -> list[object]:
    options = (*CPU, "--give-up", 3, "--report", room.folder / "report.json")
    return ["track", room.base / "model", f"recording:{source}", *options]


def recording(name: str, content: bytes) -> Make:
    return lambda room: track(room, room.file(name, content))


def _folder_of_nothing(room: Room) -> list[object]:
    (room.folder / "frames").mkdir()
    return track(room, room.folder / "frames")


_GARBAGE = bytes(range(256)) * 400

ATTACKS = attacks(
    refused={
        "model_weights_nan": _weights(np.nan),
        "model_weights_1e30": _weights(1e30),
        "model_weights_1e5": _weights(1e5),
        "model_weights_minus_1e3": _weights(-1e3),
        "model_weights_header_of_2_60": network(
            file("weights.safetensors", lambda content: struct.pack("<Q", 2**60) + b"{}")
        ),
        "model_weights_empty": network(file("weights.safetensors", lambda content: b"")),
        "model_box_nan": network(manifest(query_box_mm=[[NAN] * 3, [1.0] * 3])),
        "model_box_of_a_kilometre": network(manifest(query_box_mm=[[-1e6] * 3, [1e6] * 3])),
        "model_of_endless_width": network(
            within("config", "network", "decoder", "width", value=3 * 10**4)
        ),
        "model_shape_nan": _shape(np.nan),
        "model_shape_1e30": _shape(1e30),
        "model_shape_cut": model(_cut),
        "model_parts_swapped": model(manifest(parts=["tumor_1", "kidney", "tumor_2"])),
        "model_of_endless_parts": model(manifest(parts=[f"tumor_{n}" for n in range(10**5)])),
        "model_of_endless_steps": model(within("config", "refine", "steps", value=10**12)),
        "model_of_endless_tilts": model(within("config", "scene", "pose", "tilt_deg", value=1e300)),
        "model_of_schema_999": model(manifest(schema=999)),
        "model_config_null": model(manifest(config=None)),
        "model_up_nan": model(within("provenance", "up_lps", value=[NAN] * 3)),
        "model_names_a_file_outside": model(
            lambda model: None, then=within("files", "../../etc/passwd", value="0" * 64)
        ),
        "model_manifest_nested": model(
            lambda model: None, then=file("manifest.json", lambda content: b"[" * 1_000_000)
        ),
        "model_calibration_edited": model(lambda model: None, then=edited(_surer)),
        "case_is_a_model": lambda room: ["export", room.base / "model", room.out],
        "case_with_a_damaged_model": _case_with_a_damaged_model,
        "motions_nan": _joint(np.nan),
        "motions_off_by_3_rad": _joint(3.0),
        "motions_times_1e300": _times(1e300),
        "motions_times_backwards": _times(-1.0),
        "motions_ten_times_too_fast": _times(0.1),
        "motions_of_no_length": motions(
            lambda arrays: arrays.update({name: array[:0] for name, array in arrays.items()})
        ),
        "plan_of_a_nearer_tumor": plan(_nearer_tumor),
        "plan_in_another_cell": plan(
            file("cell.urdf", lambda text: text.replace(b'radius="0.0012"', b'radius="0.0002"'))
        ),
        "plan_without_its_cell": _without("cell.urdf"),
        "plan_without_its_piece": _without("piece.ply"),
        "plan_without_budgets": _plan_json(lambda data: data.update(budgets=[])),
        "plan_that_keeps_nan": _plan_json(lambda data: data["plan"].update(margin_mm=NAN)),
        # A stored plan that nothing looks at must move no real arm.
        "real_arm_without_live": lambda room: [
            *("resect", room.base / "plan", "ur:127.0.0.1?execute=true"),
            *("--report", room.folder / "report.json"),
        ],
        "plan_of_another_schema": lambda room: [
            *("resect", resealed(room, "plan", manifest(schema=7)))
        ],
        "run_with_points_at_nan": lambda room: [
            *("plan", resealed(room, "run", file("occupancy.ply", _points_at_nan))),
            *(room.out, "--no-arms"),
        ],
        "recording_mcap_of_garbage": recording("in.mcap", b"\x89MCAP0\r\n" + _GARBAGE),
        "recording_mcap_cut": recording("in.mcap", b"\x89MCAP0\r\n"),
        "recording_db3_of_garbage": recording("in.db3", b"SQLite format 3\0" + _GARBAGE),
        "recording_bag_of_garbage": recording("in.bag", b"#ROSBAG V2.0\n" + _GARBAGE),
        "recording_empty": recording("in.mcap", b""),
        "recording_folder_of_nothing": _folder_of_nothing,
        "source_name_of_300_bytes": lambda room: track(room, "x" * 300),
    },
    either={
        # Of depth images only, which have fewer.
        "model_of_endless_points": model(
            within("config", "scene", "cloud", "n_points", value=10**10)
        ),
    },
)
