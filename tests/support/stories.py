"""The command line as a user runs it, and small cases to run it on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

import warm
from tumortrack.case.surface import surfaces
from tumortrack.core import store
from tumortrack.core.patient import Patient
from tumortrack.io.case import Case, load_case, save_case
from tumortrack.io.model_folder import save_model
from tumortrack.simulation.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.tracking.model_files import make_model

COMMAND = [sys.executable, "-m", "tumortrack.cli.main"]


def tumortrack(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; with options of ``subprocess.run``, as a process started anew."""
    if not options and hasattr(os, "fork"):
        return warm.run([str(word) for word in arguments], environment())
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=600,
        env=environment(),
        **options,  # type: ignore[call-overload]
    )


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONUNBUFFERED": "1"}


def with_imports(
    *arguments: object, run: list[str] = COMMAND[1:]
) -> tuple[subprocess.CompletedProcess[str], set[str]]:
    """A command's end, and every module that it imported."""
    words = [sys.executable, "-X", "importtime", *run, *map(str, arguments)]
    buffered = {name: is_ for name, is_ in environment().items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, env=buffered)
    rows = [line.split("|") for line in done.stderr.splitlines() if line.startswith("import time:")]
    imported = {row[-1].strip() for row in rows}
    assert "tyro" in imported
    return done, imported


def succeeded(done: subprocess.CompletedProcess[str]) -> str:
    """The output of a command that must have worked."""
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def answered(done: subprocess.CompletedProcess[str]) -> str:
    """The output of a `locate` that found something, be it poor."""
    assert done.returncode in (0, 4), done.stdout + done.stderr
    return done.stdout


def refusal(done: subprocess.CompletedProcess[str]) -> str:
    """The one line of a command that must have refused, without a traceback."""
    assert done.returncode not in (0, 1), done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    line = done.stderr.strip().splitlines()
    assert len(line) == 1, done.stderr
    assert line[0].startswith("tumortrack: "), done.stderr
    return line[0]


def write_phantom_case(folder: Path) -> Case:
    """The built-in phantom on coarse voxels, as a case folder."""
    labels = phantom_labels(PhantomParameters(), voxel_mm=1.5)
    anatomy, _ = surfaces(labels)
    case = Case(anatomy, labels, (0.0, -1.0, 0.0), patient=Patient("P1", "right"))
    with store.new_folder(folder) as aside:
        save_case(case, aside)
    return case


STEPS = 12


def train_command(case: Path, model: Path) -> list[object]:
    """A `quick` training of seconds, with the same weights whatever number of cores there is."""
    options = ["--preset", "quick", "--steps", STEPS, "--workers", 1, "--device", "cpu"]
    return ["train", case, model, *options]


def trained(case: Path, model: Path) -> None:
    """Write a model folder of a `quick`."""
    succeeded(tumortrack(*train_command(case, model)))


def write_elastic(case: Path, model: Path) -> None:
    """Write a model folder of the preset elastic."""
    model.mkdir()
    save_model(make_model(load_case(case)), model)


def train_learnt(case_folder: Path, model: Path) -> None:
    """Write a model folder of a ``quick`` with small pictures, trained for a minute."""
    from msgspec.structs import replace

    from tumortrack_occupancy.presets import quick
    from tumortrack_occupancy.training.train import TrainingRun, train

    case = load_case(case_folder)
    preset = quick(case.anatomy)
    scene = replace(preset.scene, width=212, height=120)
    config = replace(preset, scene=scene, validation_pairs=4)
    digest = store.sha256_of(case_folder / store.MANIFEST)
    settings = {"steps": 400, "workers": 0, "device": "cpu"}
    run = TrainingRun(case.anatomy, case.up_lps, digest, config, **settings)  # type: ignore[arg-type]
    train(run, model, lambda _: None)


def looking_down(case: Case, distance_mm: float = 130.0, spin_degrees: float = 30.0) -> np.ndarray:
    """``camera_from_ct`` of a camera above the organ's anterior side, turned about its axis."""
    from scipy.spatial.transform import Rotation

    from tumortrack.core.geometry import rigid, rotation_onto

    turn = Rotation.from_euler("z", spin_degrees, degrees=True).as_matrix()
    rotation = turn @ rotation_onto(np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    centre = case.anatomy.organ.box_mm.mean(0)
    return rigid(rotation, np.array([3.0, -2.0, distance_mm + 25]) - rotation @ centre)


def cloud_by_rays(case: Case, camera_from_ct: np.ndarray, step: float = 0.006) -> np.ndarray:
    """What another program sees: rays of a pinhole camera cast by Embree through trimesh."""
    import trimesh

    from tumortrack.core.geometry import transform_points

    organ = case.anatomy.organ
    mesh = trimesh.Trimesh(
        transform_points(camera_from_ct, organ.vertices_mm), organ.faces, process=False
    )
    tangents = np.stack(np.meshgrid(*[np.arange(-0.8, 0.8, step)] * 2), -1).reshape(-1, 2)
    directions = np.column_stack([tangents, np.ones(len(tangents))])
    hits, _, _ = mesh.ray.intersects_location(
        np.zeros_like(directions), directions, multiple_hits=False
    )
    return hits


def live_resection(demo: Path, plan: Path, sink: str) -> list[str]:
    """A command for pictures: the plan, live, on the demo's phantom, which lies still."""
    source = f"virtual:{demo / 'case'}?seed=1&instrument=false&breathing=false&camera_motion=false"
    command = [*COMMAND, "resect", plan, sink, "--live", demo / "case", source, "--speed", "2"]
    return [str(word) for word in command]
