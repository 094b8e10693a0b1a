"""A world's scenes, by number: state, true anatomy, view, cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

import tumortrack as tt
from tumortrack.core import store
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import transform_points
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy
from tumortrack.io.case import Case, load_case
from tumortrack.io.mesh_files import write_anatomy
from tumortrack.io.scene_folder import InnerPoints, Scene, Targets, draw_targets, list_scenes
from tumortrack.organ.tets import TetMesh
from tumortrack_benchmarks.document import make_folder
from tumortrack_benchmarks.physics import segmentation
from tumortrack_benchmarks.physics.families import FAMILIES, Deformed, solve
from tumortrack_benchmarks.physics.kidneys import SHAPES, random_anatomy
from tumortrack_benchmarks.physics.organ import Organ, transformed
from tumortrack_benchmarks.physics.tets import TETS, kept, tetrahedralise
from tumortrack_benchmarks.physics.views import organ_cloud, render_view
from tumortrack_benchmarks.scripting import claim
from tumortrack_experiment.kit.base import laid_down as bench_from_ct

_FINE_MM, _EDGE_MM = 0.1, 7.0  # surfaces are simplified by this, edges halved beyond

Generator = np.random.Generator


class StressConfig(Config, frozen=True, kw_only=True):
    """``edge_mm``, ``envelope``: of the tetrahedra. ``hidden``: share of scenes with a hand or
    instruments, which hide up to ``most_hidden``. ``segmentation``: share of scenes whose truth
    differs from the case as CT segmentations err; 0 switches that off."""

    seed: int = 0
    edge_mm: float = 8.0
    envelope: float = 0.01
    hidden: float = 0.5
    most_hidden: float = 0.7
    segmentation: float = 0.6
    families: tuple[str, ...] = tuple(FAMILIES)

    def family(self, number: int) -> str:
        """Families take turns."""
        return self.families[number % len(self.families)]


class Shown(NamedTuple):
    """A state, the true anatomy in it and inner points (bench frame, mm); ``number``: of the state;
    ``about``: its recipe, as scenes state it; ``rng``: of the first view."""

    state: Deformed
    truth: Anatomy
    targets: Targets
    number: int
    about: dict[str, Any]
    rng: Generator


@dataclass(frozen=True, eq=False)
class StressScenes:
    """A case on the bench, simplified by 0.1 mm."""

    config: StressConfig
    case_sha256: str
    bench_from_ct: Float64[np.ndarray, "4 4"]
    organ: Organ
    targets: InnerPoints
    slices_axis: Float64[np.ndarray, " 3"]  # of the CT, bench frame

    @classmethod
    def from_case(
        cls, case: Case, case_sha256: str, config: StressConfig, mesh: TetMesh | Path
    ) -> StressScenes:
        """``mesh``: the tetrahedra (bench frame), or their file, which is written if there is
        none."""
        to_bench = bench_from_ct(case.anatomy.organ, case.up_lps)
        few = simplified(case.anatomy)
        there, axes = transformed(few, to_bench), case.labels.lps_from_index[:3, :3]
        spacing = np.linalg.norm(axes, axis=0)
        if isinstance(mesh, Path):
            size = config.edge_mm, config.envelope
            mesh = kept(mesh, lambda: tetrahedralise(there.organ, *size))
        thick = axes[:, spacing.argmax()] / spacing.max()
        return cls(
            config, case_sha256, to_bench, Organ.from_anatomy(there, mesh),
            draw_targets(few, config.seed), to_bench[:3, :3] @ thick,
        )  # fmt: skip

    @classmethod
    def opened(cls, case: Path, config: StressConfig, tets: Path) -> StressScenes:
        """The world of a case's folder."""
        return cls.from_case(load_case(case), store.sha256_of(case / store.MANIFEST), config, tets)

    def scene(self, number: int) -> Scene:
        """The same number, the same scene. Raises TumortrackError: its state has no equilibrium, or
        the organ is not found in its image (NoEstimate)."""
        return self.first(self.shown(number))

    def shown(self, number: int) -> Shown:
        """Raises TumortrackError: the state has no equilibrium."""
        config, rng = self.config, np.random.default_rng([self.config.seed, number, 1])
        state = solve(self.organ, config.family(number), config.seed * 1_000_003 + number)
        kind: segmentation.Kind = "none"
        if rng.uniform() < config.segmentation:
            kind = segmentation.KINDS[1 + rng.integers(len(segmentation.KINDS) - 1)]
        true, segmented = segmentation.perturbed(self.organ.anatomy, kind, self.slices_axis, rng)
        truth = true.with_parts(
            part.with_vertices(state.forward(part.vertices_mm)) for part in true.parts
        )
        points = state.forward(transform_points(self.bench_from_ct, self.targets.points_ct))
        about = {"family": config.family(number), "segmentation": segmented, **state.about}
        return Shown(state, truth, self.targets.at(points), number, about, rng)

    def first(self, shown: Shown) -> Scene:
        """The first view of a state. Raises NoEstimate: the organ is not found in its image."""
        return self._seen(shown, shown.number, shown.rng)

    def again(self, shown: Shown, number: int) -> Scene:
        """Another view of a state, with another noise. Raises NoEstimate: the organ is not found in
        its image."""
        return self._seen(shown, number, np.random.default_rng([self.config.seed, number, 2]))

    def _seen(self, shown: Shown, number: int, rng: Generator) -> Scene:
        config, (state, truth, targets, *_) = self.config, shown
        hidden = rng.uniform(0.05, config.most_hidden) * (rng.uniform() < config.hidden)
        view = render_view(state, truth.organ, hidden, rng)
        cloud, on_organ = organ_cloud(view, truth.organ, rng)
        meta = {
            "case_sha256": self.case_sha256,
            "world": {"number": number, "seed": config.seed},
            "state": f"{config.seed}-{shown.number}",
            **shown.about,
            **view.about,
            "cloud_on_organ": on_organ,
            "camera_from_bench": view.camera_from_bench.tolist(),
            "bench_from_ct": self.bench_from_ct.tolist(),
        }
        there = replace(
            targets, points_mm=transform_points(view.camera_from_bench, targets.points_mm)
        )
        return Scene(cloud, transformed(truth, view.camera_from_bench), view.frame, meta, there)


def simplified(anatomy_ct: Anatomy) -> Anatomy:
    """The anatomy whose triangles a world's scenes have."""
    pairs = zip(anatomy_ct.names, anatomy_ct.parts, strict=True)
    solids = (solid_of(part, name) for name, part in pairs)
    return anatomy_ct.with_parts(
        mesh_of(solid.simplify(_FINE_MM).refine_to_length(_EDGE_MM)) for solid in solids
    )


def stress_scenes(
    case: Path,
    out: Path,
    config: StressConfig,
    count: int,
    report: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """The scenes of a case's first states, families in turn: OUT/00000-rest, ...; those that are
    missing are made. OUT/world.json states case and configuration, OUT/failures.json the states
    that have no equilibrium and the views in which no organ is found. Raises InputError: OUT holds
    other files, or scenes of another case or configuration."""
    identity = {"case_sha256": store.sha256_of(case / store.MANIFEST)}
    claim(out, "world.json", {**identity, "config": to_builtins(config)})
    path, names = out / "failures.json", [f"{n:05d}-{config.family(n)}" for n in range(count)]
    failures = store.read_json(path) if path.exists() else {}
    todo = [n for n in names if n not in failures and not (out / n).exists()]
    world = StressScenes.opened(case, config, out / TETS) if todo else None
    for name in todo:
        assert world is not None
        try:
            world.scene(names.index(name)).write(out / name)
        except TumortrackError as error:
            failures[name] = f"{type(error).__name__}: {error}"
            store.write_json(path, failures)
        report(f"{name}: {failures.get(name, 'made')}")
    return [out / name for name in names if name not in failures]


def random_case(
    folder: Path, number: int, shape: str = "kidney", up_lps: tuple[float, ...] | None = None
) -> Path:
    """A random organ, prepared, with its model: FOLDER/case, made if it is not there. ``shape``: of
    ``kidneys.SHAPES``; ``up_lps``: what faces the camera, instead of a random side."""
    case = folder / "case"
    if not case.exists():
        anatomy_ct, side = random_anatomy(number, SHAPES[shape])
        make_folder(folder)
        with TemporaryDirectory() as aside:
            write_anatomy(Path(aside), anatomy_ct)
            up = ",".join(f"{value:.6f}" for value in up_lps or side)
            tt.prepare(aside, case, up=up, name=shape)
    return case


def random_scenes(folder: Path, number: int, states: int, shape: str = "kidney") -> list[Path]:
    """``stress_scenes`` of a random organ, in FOLDER/scenes."""
    case = random_case(folder, number, shape)
    return stress_scenes(case, folder / "scenes", StressConfig(seed=number), states)


def simulated_scenes(folder: Path, number: int, count: int) -> list[Path]:
    """Scenes of a random kidney as ``tumortrack simulate --elastic`` makes them, in
    FOLDER/simulated."""
    case, out = random_case(folder, number), folder / "simulated"
    tt.write_scenes(case, out, scenes=count, seed=77, elastic=True)
    return list_scenes(out)[:count]
