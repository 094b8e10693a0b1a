"""Says what a folder or file is."""

from __future__ import annotations

from pathlib import Path

from tumortrack.core import store
from tumortrack.core.errors import InputError

_NAMES = {"pretrained": "pretrained weights"}  # where the kind is no noun


def describe(path: Path) -> list[str]:
    """Lines about a case, model, run, scene, report or cloud.

    Raises:
        InputError: nothing that tumortrack knows.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    if (path / store.MANIFEST).is_file():
        return _artifact(path)
    if (path / "twin.json").is_file():
        made = sum((p / "cloud.ply").is_file() for p in path.iterdir())
        return [
            f"{path}: twin scenes that are not finished ({made} so far); the same `twin` command "
            "resumes them."
        ]
    if (path / "training").is_dir():
        return [f"{path}: a training that has not ended; the same command resumes it."]
    if (path / "cloud.ply").is_file():
        return _scene(path)
    if path.is_dir() and any((p / "cloud.ply").is_file() for p in path.iterdir()):
        from tumortrack.simulate.scene_folder import list_scenes

        return [f"{path}: {len(list_scenes(path))} scenes; `tumortrack evaluate` reads them."]
    report = path / "report.json" if path.is_dir() else path
    if report.name == "report.json" and report.is_file():
        summary = store.read_json(report).get("summary", {})
        return [f"{path}: an evaluation report.", *(f"  {k}: {v}" for k, v in summary.items())]
    from tumortrack.sense.files import CLOUD_SUFFIXES, read_cloud

    if path.suffix.lower() in CLOUD_SUFFIXES:
        cloud, notes = read_cloud(path)
        lower, upper = cloud.points_mm.min(0), cloud.points_mm.max(0)
        box = f"{lower.round(1).tolist()} to {upper.round(1).tolist()}"
        return [f"{path}: {len(cloud.points_mm)} points from {box}", *notes]
    raise InputError(
        f"{path} is no case, model, run, scene, report or cloud of tumortrack's. "
        "Volumes and label maps go to `tumortrack prepare`."
    )


def _artifact(folder: Path) -> list[str]:
    kind = store.read_json(folder / store.MANIFEST).get("kind")
    manifest = store.read_manifest(folder, str(kind))
    what = _NAMES.get(str(kind), f"a {kind}")
    lines = [
        f"{folder}: {what} (schema {manifest['schema']}, tumortrack {manifest['tumortrack']}); "
        f"{manifest['units']}, {manifest['frame']} frame; all files as they were written."
    ]
    if isinstance(scenes := manifest.get("scenes"), dict):
        return [*lines, *_sealed_scenes(folder, scenes)]
    if kind == "model":
        from tumortrack.occupancy import compiled  # PyTorch takes a second

        lines += [_kind_of_model(manifest), *(f"  {line}" for line in compiled.describe(folder))]
    skip = {"kind", "schema", "tumortrack", "units", "frame", "files", "config"}
    lines += [f"  {key}: {value}" for key, value in manifest.items() if key not in skip]
    return [*lines, f"  files: {', '.join(manifest['files'])}"]


def _kind_of_model(manifest: dict) -> str:
    network = manifest.get("config", {}).get("network", {})
    kinds = [network.get(part, {}).get("type", "?") for part in ("encoder", "decoder")]
    if kinds[1] == "warp":
        does = "places the organ of the CT; `locate --map` says where points of the CT are"
    else:
        does = "labels points; it does not know which point of the CT lies where (no `--map`)"
    return f"  {kinds[0]} + {kinds[1]}: {does}"


def _sealed_scenes(folder: Path, scenes: dict) -> list[str]:
    """What became of the scenes that a manifest lists."""
    changed = [
        name
        for name, digest in scenes.items()
        if not (folder / name).is_dir() or store.sha256_of(folder / name) != digest
    ]
    lines = [f"  {len(scenes)} scenes: {', '.join(scenes)}"]
    if changed:
        return [*lines, f"  CHANGED or missing since they were sealed: {', '.join(changed)}"]
    return [*lines, "  all as they were sealed; `tumortrack evaluate` reads them."]


def _scene(folder: Path) -> list[str]:
    from tumortrack.simulate.scene_folder import read_scene

    scene = read_scene(folder)
    volumes = ", ".join(
        f"{name} {part.volume_mm3 / 1000:.1f} ml"
        for name, part in zip(scene.reference.names, scene.reference.parts, strict=True)
    )
    targets = f", {len(scene.targets.labels)} targets" if scene.targets else ""
    points = f"{len(scene.cloud.points_mm)} points"
    return [f"{folder}: a scene with {points}; truth: {volumes}{targets}."]
