"""A case -> the folder of its twin's scenes, state by state, resumable at any point.

SCENES/
  twin.json                     the inputs of everything here
  states/STATE.safetensors      the anatomy at rest in each state (bench frame), with its report
  VARIANT-VIEW/                 a scene each, with targets.csv and scene.png
  manifest.json                 the seal, last: sha256 of every scene
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from tumortrack.core import colours, store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import Anatomy
from tumortrack.imaging.case import Case, load_case
from tumortrack.report.pictures import depth_picture, scene_views, write_sheet
from tumortrack.simulate.scene_folder import (
    TARGETS,
    InnerPoints,
    Scene,
    draw_targets,
    write_scene_files,
)
from tumortrack_lab.study.document import make_folder
from tumortrack_lab.twin import views as viewing
from tumortrack_lab.twin.apparatus import Apparatus, ApparatusConfig, State, solve
from tumortrack_lab.twin.views import VARIANTS, VIEWS, EquilibriumState

KIND = "twin"
_STATES = "states"
# More compression starts from less: the same answer in fewer load steps.
_GOES_ON_FROM = {"D2": "D1", "D3": "D2"}


@dataclass(frozen=True)
class TwinRun:
    """Inputs of all files: a case, the bench, the views, one seed (of views and targets)."""

    case_folder: Path
    bench: ApparatusConfig = field(default_factory=ApparatusConfig)
    view: viewing.ViewConfig = field(default_factory=viewing.ViewConfig)
    seed: int = 0
    build: Callable[[Anatomy, tuple[float, float, float], ApparatusConfig], Any] = Apparatus
    solve: Callable[..., State] = solve  # these two have stand-ins in tests


def make_scenes(
    run: TwinRun,
    out: Path,
    variants: Sequence[str] = tuple(VARIANTS),
    views: Sequence[viewing.View] = VIEWS,
    report: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Make the scenes of these variants in these views, unless they are there; returns their
    folders. A state is solved once and kept; a killed run loses only the present state or scene.
    ``report`` gets a line of progress.

    Raises InputError: no case, an unknown variant or view, ``out`` holds something else, or scenes
    made from another case, seed or configuration; ArtifactError: a kept state is damaged;
    TumortrackError: a state has no equilibrium; StorageError: the disk refused.
    """
    wanted = [(v, w) for v in known(variants, VARIANTS) for w in known(views, VIEWS)]
    case = load_case(run.case_folder)
    targets, rest_ct = draw_targets(case.anatomy, run.seed), case.anatomy.organ
    identity = {
        "case_sha256": store.sha256_of(run.case_folder / store.MANIFEST),
        "seed": run.seed,
        "targets": TARGETS,
        "bench_config": to_builtins(run.bench),
        "view_config": to_builtins(run.view),
    }
    claim(out, "twin.json", identity)
    make_folder(out / _STATES)
    todo = [(v, w) for v, w in wanted if not (out / f"{v}-{w}").exists()]
    states = list(dict.fromkeys(VARIANTS[v].state for v, _ in todo))
    cache = StateCache(out / _STATES, run, case, targets)
    done = 0
    for name in states:
        state = cache.get(name, report)
        for variant, view in todo:
            if VARIANTS[variant].state == name:
                height_mm = float(np.ptp(rest_ct.vertices_mm @ state.bench_from_ct[2, :3]))
                config = viewing.for_organ(run.view, height_mm)
                scene, targets_mm = viewing.make_scene(state, variant, view, config, run.seed)
                meta = {**identity, **scene.meta}
                scene = replace(scene, meta=meta, targets=targets.at(targets_mm))
                with store.new_folder(out / f"{variant}-{view}") as aside:
                    write_scene_files(aside, scene)
                    twin_picture(scene, aside / "scene.png")
                done += 1
                report(f"{done} of {len(todo)} scenes: {variant}-{view}")
    names = [f"{variant}-{view}" for variant in VARIANTS for view in VIEWS]
    scenes = {name: store.sha256_of(out / name) for name in names if (out / name).is_dir()}
    store.seal(out, KIND, {**identity, "scenes": scenes}, frame="camera")
    return [out / f"{v}-{w}" for v, w in wanted]


def twin_picture(scene: Scene, path: Path) -> None:
    """Depth image, and the cloud over the truth's outlines from the camera and from above."""
    assert scene.depth is not None
    depth_mm, (near, far) = scene.depth.depth_mm, scene.meta["crop_mm"]
    kept = np.where((depth_mm > near) & (depth_mm < far), depth_mm, np.nan).astype(np.float32)
    seen = depth_picture(replace(scene.depth, depth_mm=kept))
    panels = [(f"depth image, cropped to {near:g} .. {far:g} mm", seen), *scene_views(scene, {})]
    words = f"{scene.meta['variant']}, {scene.meta['view']}"
    write_sheet(path, [], [words], {"truth (outline)": colours.TRUTH}, [panels])


def known(names: Sequence[Any], allowed: Iterable[str]) -> list:
    """The names, each once. Raises InputError: one is not allowed, or there are none."""
    for name in names:
        if name not in allowed:
            raise InputError(f"{name!r} is not known; allowed: {', '.join(allowed)}.")
    if not names:
        raise InputError(f"nothing to make; choose among {', '.join(allowed)}.")
    return list(dict.fromkeys(names))


def claim(out: Path, name: str, identity: dict) -> None:
    """Write the inputs of a folder of scenes into a file there, or check that they are the same.
    Raises InputError: they are not, or the folder holds other files; StorageError."""
    path = out / name
    if path.exists():
        differ = [k for k, v in identity.items() if store.read_json(path).get(k) != v]
        if differ:
            raise InputError(
                f"{out} holds scenes of another {' and '.join(differ)}. Choose another folder, or "
                "remove this one."
            )
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} holds other files. Choose a new or empty folder for the scenes.")
    make_folder(out)
    store.write_json(path, identity)


class StateCache:
    """The states of one case on disk, one file each, so that none is solved twice."""

    def __init__(self, folder: Path, run: TwinRun, case: Case, targets: InnerPoints) -> None:
        self._folder, self._run, self._case, self._targets = folder, run, case, targets
        self._bench: Any = None  # built when the first state is solved
        self._kind = case.anatomy.kind
        self._parts = dict(zip(case.anatomy.names, case.anatomy.parts, strict=True))

    def has(self, name: str) -> bool:
        return self._path(name).exists()

    def get(self, name: str, say: Callable[[str], None]) -> EquilibriumState:
        """The state, which is solved and kept if it is new; ``say`` gets a line per load step."""
        if not self.has(name):
            self._solve(name, say)
        tensors, report, _ = self._read(name)
        parts = [part.moved(tensors[key]) for key, part in self._parts.items()]
        targets_mm, bench_from_ct = tensors["targets"], tensors["bench_from_ct"]
        return EquilibriumState(
            name, Anatomy(tuple(parts), self._kind), targets_mm, bench_from_ct, report
        )

    def _solve(self, name: str, say: Callable[[str], None]) -> None:
        if self._bench is None:
            say("bench: filling the organ with tetrahedra")
            self._bench = self._run.build(self._case.anatomy, self._case.up_lps, self._run.bench)
        bench, warm = self._bench, None
        mesh = hashlib.sha256(np.ascontiguousarray(bench.mesh.nodes_mm).tobytes()).hexdigest()
        if (before := _GOES_ON_FROM.get(name)) and self.has(before):
            tensors, report, of = self._read(before)
            warm = State(before, tensors["nodes"], report) if of == mesh else None
        solved = self._run.solve(bench, name, warm, lambda line: say(f"{name}: {line}"))
        points = {key: part.vertices_mm for key, part in self._parts.items()}
        points["targets"] = self._targets.points_ct
        tensors = {key: bench.carry(solved, some) for key, some in points.items()}
        tensors |= {"bench_from_ct": bench.bench_from_ct, "nodes": solved.nodes_mm}
        metadata = {"report": json.dumps(solved.report, allow_nan=False), "mesh": mesh}
        contiguous = {key: np.ascontiguousarray(array) for key, array in tensors.items()}
        store.write_atomically(self._path(name), save(contiguous, metadata))

    def _read(self, name: str) -> tuple[dict[str, np.ndarray], dict, str]:
        """A kept state: its arrays, its report, and the sha256 of its tetrahedra's nodes."""
        path = self._path(name)
        try:
            with safe_open(path, framework="np") as file:
                keys = (*self._parts, "targets", "bench_from_ct", "nodes")
                tensors = {key: file.get_tensor(key) for key in keys}
                metadata = file.metadata() or {}
            return tensors, json.loads(metadata["report"]), metadata["mesh"]
        except (SafetensorError, KeyError, ValueError, OSError) as error:
            raise ArtifactError(
                f"{path} is damaged: {error}. Remove it, and the state is solved again."
            ) from error

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.safetensors"
