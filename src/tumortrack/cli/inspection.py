"""What lies in a folder: `inspect`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError

_NAMES = {"pretrained": "pretrained weights"}  # where the kind is no noun


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Say what a case, model, run, scene or report is.

    Attributes:
        path: folder or file.
    """

    path: Positional[Path]

    def run(self) -> None:
        for line in describe(self.path):
            say(line)


def describe(path: Path) -> list[str]:
    """Lines about a case, model, run, scene, report or cloud. Raises InputError: nothing that
    tumortrack knows."""
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
        return [f"{path}: an evaluation report.", *_evaluation(store.read_json(report))]
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


def _evaluation(report: dict[str, Any]) -> list[str]:
    """In sentences."""
    from tumortrack.report.summary import headlines, scene_lines

    try:
        lines = [*headlines(report["summary"]), *scene_lines(report["scenes"])]
    except (KeyError, TypeError, AttributeError):
        lines = [
            "Another version wrote it, or another program; `tumortrack evaluate` makes it again."
        ]
    return [f"  {line}" for line in lines]


def _artifact(folder: Path) -> list[str]:
    kind = str(store.read_json(folder / store.MANIFEST).get("kind"))
    manifest = store.read_manifest(folder, kind)
    lines = [
        f"{folder}: {_NAMES.get(kind, f'a {kind}')} (schema {manifest['schema']}, tumortrack "
        f"{manifest['tumortrack']}); {manifest['units']}, {manifest['frame']} frame; all files as "
        "they were written."
    ]
    if isinstance(scenes := manifest.get("scenes"), dict):  # with the digests they were sealed by
        as_sealed = {
            name: (folder / name).is_dir() and store.sha256_of(folder / name) == digest
            for name, digest in scenes.items()
        }
        changed = ", ".join(name for name, same in as_sealed.items() if not same)
        verdict = "all as they were sealed; `tumortrack evaluate` reads them."
        if changed:
            verdict = f"CHANGED or missing since they were sealed: {changed}"
        return [*lines, f"  {len(scenes)} scenes: {', '.join(scenes)}", f"  {verdict}"]
    if kind == "model":
        from tumortrack.cli.margins import described
        from tumortrack.models.folder import weakness_of
        from tumortrack.models.margins import UNKNOWN, read_margins

        network = manifest.get("config", {}).get("network", {})
        encoder, decoder = (network.get(n, {}).get("type", "?") for n in ("encoder", "decoder"))
        does = "labels points; it does not know which point of the CT lies where (no `--map`)"
        if decoder == "warp":
            does = "places the organ of the CT; `locate --map` says where points of the CT are"
        lines.append(f"  {encoder} + {decoder}: {does}")
        weakness = weakness_of(manifest.get("provenance", {}))
        lines += [f"  WARNING: {weakness}"] if weakness else []
        margins = read_margins(folder)
        lines += [f"  {line}" for line in (described(margins) if margins else [UNKNOWN])]
    if kind == "case":
        said = manifest.get("report", {}).get("half_turn", {}).get("warning")
        lines += [f"  WARNING: {said}"] if said else []
    skip = {"kind", "schema", "tumortrack", "units", "frame", "files", "config"}
    lines += [f"  {key}: {value}" for key, value in manifest.items() if key not in skip]
    return [*lines, f"  files: {', '.join(manifest['files'])}"]


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
