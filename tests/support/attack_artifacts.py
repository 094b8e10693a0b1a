"""Hostile input: models, plans and runs whose files were changed, and recordings."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from attack_registry import ATTACKS, Attack, Made, attack


def resealed(folder: Path, source: Path, change: Callable[[Path], object]) -> Path:
    """A copy of an artifact whose files were changed and whose manifest says so."""
    import shutil

    from tumortrack.core import store

    copy = folder / "changed"
    shutil.copytree(source, copy)
    change(copy)
    manifest = json.loads((copy / store.MANIFEST).read_text())
    for name in manifest["files"]:
        manifest["files"][name] = store.sha256_of(copy / name)
    (copy / store.MANIFEST).write_text(json.dumps(manifest))
    return copy


def with_model(change: Callable[[Path], object], name: str = "model") -> Attack:
    def make(folder: Path, base: Path) -> Made:
        model = resealed(folder, base / name, change)
        cloud = base / "scenes" / "0000" / "cloud.ply"
        return ["locate", model, cloud, folder / "out", "--device", "cpu"]

    return make


def with_network(change: Callable[[Path], object]) -> Attack:
    return with_model(change, "network")


def weights(fill: float) -> Callable[[Path], object]:
    def change(model: Path) -> None:
        from safetensors.numpy import load_file, save_file

        path = model / "weights.safetensors"
        tensors = {name: np.full_like(value, fill) for name, value in load_file(path).items()}
        save_file(tensors, path)

    return change


def manifest(**changes: object) -> Callable[[Path], object]:
    def change(artifact: Path) -> None:
        path = artifact / "manifest.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


ATTACKS |= {
    "model_weights_nan": with_network(weights(np.nan)),
    "model_weights_1e30": with_network(weights(1e30)),
    "model_weights_1e5": with_network(weights(1e5)),
    "model_weights_minus_1e3": with_network(weights(-1e3)),
    "model_weights_header_of_2_60": with_network(
        lambda model: (model / "weights.safetensors").write_bytes(struct.pack("<Q", 2**60) + b"{}")
    ),
    "model_weights_empty": with_network(
        lambda model: (model / "weights.safetensors").write_bytes(b"")
    ),
    "model_box_nan": with_network(manifest(query_box_mm=[[float("nan")] * 3, [1.0] * 3])),
    "model_box_of_a_kilometre": with_network(manifest(query_box_mm=[[-1e6] * 3, [1e6] * 3])),
    "model_of_endless_width": with_network(
        lambda model: _set(model, 3 * 10**4, "network", "decoder", "width")
    ),
    "model_shape_nan": with_model(lambda model: _spoil(model / "shape.safetensors", np.nan)),
    "model_shape_1e30": with_model(lambda model: _spoil(model / "shape.safetensors", 1e30)),
    "model_shape_cut": with_model(lambda model: _cut(model / "shape.safetensors")),
    "model_parts_swapped": with_model(manifest(parts=["tumor_1", "kidney", "tumor_2"])),
    "model_of_endless_parts": with_model(manifest(parts=[f"tumor_{n}" for n in range(10**5)])),
    "model_of_endless_steps": with_model(lambda model: _set(model, 10**12, "refine", "steps")),
    "model_of_endless_points": with_model(
        lambda model: _set(model, 10**10, "scene", "cloud", "n_points")
    ),
    "model_of_endless_tilts": with_model(
        lambda model: _set(model, 1e300, "scene", "pose", "tilt_deg")
    ),
    "model_of_schema_999": with_model(manifest(schema=999)),
    "model_config_null": with_model(manifest(config=None)),
    "model_up_nan": with_model(lambda model: _say(model, up_lps=[float("nan")] * 3)),
    "case_is_a_model": lambda folder, base: ["export", base / "model", folder / "out"],
}


@attack
def _case_with_a_damaged_model(folder: Path, base: Path) -> Made:
    """The model in the case was cut short after it was made."""
    import shutil

    case = folder / "case"
    shutil.copytree(base / "case", case)
    shutil.copytree(base / "model", case / "model")
    _cut(case / "model" / "shape.safetensors")
    return ["locate", case, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:5000])


def _set(model: Path, value: object, *keys: str) -> None:
    path = model / "manifest.json"
    whole = json.loads(path.read_text())
    inner = whole["config"]
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    path.write_text(json.dumps(whole))


def _say(model: Path, **provenance: object) -> None:
    path = model / "manifest.json"
    whole = json.loads(path.read_text())
    whole["provenance"] |= provenance
    path.write_text(json.dumps(whole))


def _spoil(path: Path, value: float) -> None:
    from safetensors.numpy import load_file, save_file

    tensors = load_file(path)
    for tensor in tensors.values():
        if tensor.dtype.kind == "f":
            tensor.reshape(-1)[:5] = value
    save_file(tensors, path)


@attack
def _model_names_a_file_outside(folder: Path, base: Path) -> Made:
    """A manifest whose list of files leaves the folder."""
    model = resealed(folder, base / "model", lambda copy: None)
    listed = json.loads((model / "manifest.json").read_text())
    listed["files"]["../../etc/passwd"] = "0" * 64
    (model / "manifest.json").write_text(json.dumps(listed))
    return ["locate", model, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


@attack
def _model_manifest_nested(folder: Path, base: Path) -> Made:
    model = resealed(folder, base / "model", lambda copy: None)
    (model / "manifest.json").write_text("[" * 1_000_000)
    return ["locate", model, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


@attack
def _model_calibration_edited(folder: Path, base: Path) -> Made:
    """A model that is said to be a million times as sure of itself."""
    model = resealed(folder, base / "model", lambda copy: None)
    path = model / "manifest.json"
    text = json.loads(path.read_text())

    def shrink(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                key: 1e-6 if key == "std_scale" else shrink(inner) for key, inner in value.items()
            }
        return value

    path.write_text(json.dumps(shrink(text)))
    return ["locate", model, base / "scenes" / "0000" / "cloud.ply", folder / "out"]


def motions(change: Callable[[dict[str, np.ndarray]], object]) -> Attack:
    def edit(plan: Path) -> None:
        from safetensors import safe_open
        from safetensors.numpy import load_file, save_file

        path = plan / "motions.safetensors"
        with safe_open(path, "np") as stream:
            said = stream.metadata()
        tensors = load_file(path)
        change(tensors)
        save_file(tensors, path, metadata=said)

    def make(folder: Path, base: Path) -> Made:
        plan = resealed(folder, base / "plan", edit)
        return ["resect", plan, "--speed", 20, "--report", folder / "report.json"]

    return make


def _put_joint(tensors: dict[str, np.ndarray], value: float) -> None:
    tensors["1.joints_rad"] = tensors["1.joints_rad"].copy()
    tensors["1.joints_rad"][10, 3] += value


def _scale_times(tensors: dict[str, np.ndarray], factor: float) -> None:
    for name in tensors:
        if name.endswith("times_s"):
            tensors[name] = tensors[name] * factor


ATTACKS |= {
    "motions_nan": motions(lambda tensors: _put_joint(tensors, np.nan)),
    "motions_off_by_3_rad": motions(lambda tensors: _put_joint(tensors, 3.0)),
    "motions_times_1e300": motions(lambda tensors: _scale_times(tensors, 1e300)),
    "motions_times_backwards": motions(lambda tensors: _scale_times(tensors, -1.0)),
    "motions_ten_times_too_fast": motions(lambda tensors: _scale_times(tensors, 0.1)),
    "motions_of_no_length": motions(
        lambda tensors: tensors.update({name: value[:0] for name, value in tensors.items()})
    ),
}


@attack
def _real_arm_without_live(folder: Path, base: Path) -> Made:
    """A stored plan that nothing looks at must move no real arm."""
    report = folder / "report.json"
    return ["resect", base / "plan", "ur:127.0.0.1?execute=true", "--report", report]


@attack
def _plan_of_another_schema(folder: Path, base: Path) -> Made:
    return ["resect", resealed(folder, base / "plan", manifest(schema=7))]


@attack
def _run_with_points_at_nan(folder: Path, base: Path) -> Made:
    def change(run: Path) -> None:
        content = (run / "occupancy.ply").read_bytes()
        start = content.index(b"end_header") + 11
        nan = struct.pack("<f", float("nan")) * 3
        (run / "occupancy.ply").write_bytes(content[:start] + nan + content[start + 12 :])

    return ["plan", resealed(folder, base / "run", change), folder / "out", "--no-arms"]


def track(folder: Path, base: Path, source: str) -> Made:
    options = ["--device", "cpu", "--give-up", 3, "--report", folder / "report.json"]
    return ["track", base / "model", source, *options]


for name, file, content in (
    ("recording_mcap_of_garbage", "in.mcap", b"\x89MCAP0\r\n" + bytes(range(256)) * 400),
    ("recording_mcap_cut", "in.mcap", b"\x89MCAP0\r\n"),
    ("recording_db3_of_garbage", "in.db3", b"SQLite format 3\0" + bytes(range(256)) * 400),
    ("recording_bag_of_garbage", "in.bag", b"#ROSBAG V2.0\n" + bytes(range(256)) * 400),
    ("recording_empty", "in.mcap", b""),
):

    def _make(folder: Path, base: Path, file: str = file, content: bytes = content) -> Made:
        (folder / file).write_bytes(content)
        return track(folder, base, f"recording:{folder / file}")

    ATTACKS[name] = _make


@attack
def _recording_folder_of_nothing(folder: Path, base: Path) -> Made:
    (folder / "frames").mkdir()
    return track(folder, base, f"recording:{folder / 'frames'}")


@attack
def _source_name_of_300_bytes(folder: Path, base: Path) -> Made:
    return track(folder, base, "recording:" + "x" * 300)
