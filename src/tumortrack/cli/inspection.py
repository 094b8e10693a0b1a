"""What lies in a folder, and what this machine can do: `inspect` and `doctor`."""

from __future__ import annotations

import platform
import shutil
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.process import available_cores

_NAMES = {"pretrained": "pretrained weights"}  # where the kind is no noun
_LIBRARIES = {
    "torch": "training and locating",
    "numba": "rendering, deforming and refining",
    "SimpleITK": "DICOM",
    "nibabel": "NIfTI",
    "embreex": "ray visibility",
    "manifold3d": "mesh unions",
    "skimage": "surfaces",
    "trimesh": "mesh files",
    "pypcd4": ".pcd clouds",
    "plotly": "3-D page",
}
_OPTIONAL = {
    "viser": "web viewer",
    "rosbags": "ROS messages and recordings",
    "cyclonedds": "ROS 2 without ROS",
    "rclpy": "ROS 2 through your ROS",
    "pyrealsense2": "RealSense cameras",
    "highdicom": "DICOM segmentations",
    "pinocchio": "arms: kinematics and collisions",
    "toppra": "arms: timing",
    "ruckig": "arms: homing",
    "ur_analytic_ik": "arms: inverse kinematics",
    "rtde_control": "real arms of Universal Robots",
}
_DISTRIBUTIONS = {"skimage": "scikit-image"}


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


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what works on this machine."""

    def run(self) -> None:
        """Print the machine, each library by importing it, and what bf16 and CUDA offer."""
        from tumortrack.live.spec import extensions

        say(f"tumortrack {version('tumortrack')}, Python {platform.python_version()}")
        say(f"cores: {available_cores()}, {platform.machine()}, {platform.system()}")
        free = shutil.disk_usage(Path.cwd()).free / 2**30
        say(f"free disk here: {free:.1f} GiB" + (" - little" if free < 2 else ""))
        for name, purpose in _LIBRARIES.items():
            try:
                import_module(name)
                say(f"ok       {name} {version(_DISTRIBUTIONS.get(name, name))} ({purpose})")
            except Exception as error:  # whatever a broken installation raises is the finding
                say(f"BROKEN   {name} ({purpose}): {error}")
        for name, purpose in _OPTIONAL.items():
            say(f"{'ok      ' if find_spec(name) else 'absent  '} {name} ({purpose})")
        for one in extensions():
            state, fault = ("BROKEN  ", f": {one.fault}") if one.fault else ("ok      ", "")
            say(f"{state} {one.what} {one.kind} of the package {one.package}{fault}")

        import torch

        from tumortrack.models.hardware import has_fast_bfloat16

        fast = has_fast_bfloat16(torch.device("cpu"))
        bf16 = "in hardware, used" if fast else "not in hardware; fp32 is used (slower)"
        say(f"CPU bf16: {bf16}")
        if torch.cuda.is_available():
            say(f"CUDA: {torch.cuda.get_device_name()}")
        else:
            say("CUDA: none; everything runs on the CPU")


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
