"""The digital twin: the paper's bench with one case on it, and the scenes of it.

After the paper's section Experiments, and Altamar et al. 2011 (doi 10.1117/12.877992) for G1. D0:
as in the CT, taken free of stress. D1, D2, D3: the midsection pressed to 4, 8, 12 mm less between a
plate and the bed. G1: turgor lost after an incision, softened tissue sinks under its weight by 8 mm
at the midsection. P1: a rod of 8 mm with a round end pressed 10 mm into the side that faces the
camera, away from the tumors. The CT shows the organ at rest under its weight in its bed: only what
is added deforms it.

SCENES/
  twin.json           the inputs of everything here
  tets.safetensors    the tetrahedra, as filling an organ is not reproducible
  VARIANT-VIEW/       a scene each, with targets.csv and scene.png
  manifest.json       the seal, last: sha256 of every scene
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from tumortrack.core import colours, store
from tumortrack.core.camera import d405
from tumortrack.core.cloud import CloudConfig, cloud_from_depth
from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import rigid, transform_points, triangles_of
from tumortrack.core.render import render_depth
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.io.case import load_case
from tumortrack.io.scene_folder import TARGETS, Scene, draw_targets, write_scene_files
from tumortrack.report.pictures import depth_picture, scene_views, write_sheet
from tumortrack.simulation.noise import D405_NOISE, add_noise
from tumortrack_benchmarks.physics.equilibrium import ContactPlate, Nodes, Points, Rod, Support
from tumortrack_benchmarks.physics.families import (
    GRAVITY_MN_MM3,
    Deformed,
    equilibria,
    even_tissue,
    volume_change,
)
from tumortrack_benchmarks.physics.forces import Force, Obstacle, Steady, Touch, Weight
from tumortrack_benchmarks.physics.occluders import add_background, occlude, shaft_over
from tumortrack_benchmarks.physics.organ import Organ, Stage, transformed
from tumortrack_benchmarks.physics.tets import TETS, kept, tetrahedralise
from tumortrack_benchmarks.scripting import claim, known
from tumortrack_experiment.kit.base import laid_down as bench_from_ct
from tumortrack_experiment.kit.stands import COMPRESSION_MM, poke_point

KIND = "twin"
EDGE_MM, SAMPLE_MM = 5.5, 1.5  # of the tetrahedra; one point of contact per cube of this size
_RIM = 0.3  # of the organ's height: ground round it, where a scene shows some
_CONTACT_KPA_MM, _PACKING_KPA_MM = 300.0, 3.0  # few kPa sink in by 0.1 mm; of fat or foam
_STEEPEST = 1.5  # slope of the underside, which packing bears
_PLATE_MM, _ROUNDING_MM = 36.0, 4.0  # the plate's width along the organ, and of its edges
_STEP_MM = 2.0  # the plate advances by this much at a time, the rod by half
_SINK_MM, _SINK_TOLERANCE_MM, _SINK_STEPS = 8.0, 0.4, 15
_POKE_MM, _ROD_MM = 10.0, 4.0  # depth; radius
STATES = ("D0", *COMPRESSION_MM, "G1", "P1")

View = Literal["clean", "noise", "shaft", "clutter"]
VIEWS: tuple[View, ...] = get_args(View)
_ABOVE_MM = 150.0  # of the camera over the support
# From the camera to the top of the undeformed organ, at least: over a taller one it is raised.
_NEAREST_MM = 85.0
_NEAR_MM = 50.0  # depths kept, down to the support: the paper's 110 mm would cut off an organ's top
_SHAFT_MM, _CLUTTER = 4.0, 0.03  # radius of the shaft; background points among all


class Variant(NamedTuple):
    """A state of the bench, turned about the camera's axis."""

    state: str
    turn_degrees: int = 0


VARIANTS = {name: Variant(name) for name in ("D0", "D1", "D2", "D3")}
VARIANTS |= {f"Rot{turn}": Variant("D0", turn) for turn in (90, 180, 270)}
VARIANTS |= {name: Variant(name) for name in ("G1", "P1")}
USUAL = tuple(VARIANTS)
TURNED = {
    f"{state}Rot{turn}": Variant(state, turn) for state in COMPRESSION_MM for turn in (90, 180, 270)
}
VARIANTS |= TURNED


@dataclass(frozen=True, eq=False)
class Bench:
    """A case's organ in its bed: a support, and packing that fits the underside. On a bare plane an
    organ that stands on its pole would collapse, which says nothing of plates and instruments."""

    stage: Stage
    bench_from_ct: Float64[np.ndarray, "4 4"]
    always: tuple[Force, ...]

    @classmethod
    def from_anatomy(
        cls, anatomy_ct: Anatomy, up_lps: tuple[float, float, float], tets: Path
    ) -> Bench:
        """``tets``: file of the tetrahedra, which is written if there is none."""
        to_bench = bench_from_ct(anatomy_ct.organ, up_lps)
        there = transformed(anatomy_ct, to_bench)
        mesh = kept(tets, lambda: tetrahedralise(there.organ, EDGE_MM))
        organ = Organ.from_anatomy(there, mesh, SAMPLE_MM)
        stage = Stage(organ, even_tissue(organ))
        under = np.flatnonzero(_faces_down(there.organ, organ.points_mm))
        heights = Support(organ.points_mm[under, 2])
        packing = Touch(stage.rows(under), organ.areas_mm2[under], heights, _PACKING_KPA_MM)
        support = stage.touch(Support(), _CONTACT_KPA_MM)
        return cls(stage, to_bench, (support, packing, Steady.from_solid(stage.solid)))

    def load(self, nodes: Nodes, *obstacles: Obstacle, weight: float = 0.0) -> Nodes:
        """At rest among obstacles, under so many weights more than in the CT. Raises
        TumortrackError: no equilibrium."""
        down = weight * GRAVITY_MN_MM3 * self.stage.solid.node_volumes_mm3[:, None] * [0, 0, -1.0]
        touching = (self.stage.touch(one, _CONTACT_KPA_MM) for one in obstacles)
        forces = (*self.always, *touching, Weight(down))
        return equilibria(self.stage.solid, [forces], nodes)[0][0]

    def load_n(self, nodes: Nodes, obstacle: Obstacle) -> float:
        """How much of an obstacle's weight the organ bears."""
        force = self.stage.touch(obstacle, _CONTACT_KPA_MM).energy(nodes)[1]
        return float(force[:, 2].sum()) / 1000

    def sunk_in_mm(self, nodes: Nodes, *obstacles: Obstacle) -> float:
        """The deepest penetration of the surface into the support or an obstacle."""
        points = self.stage.rows() @ nodes
        return max(0.0, *(-float(o.distance(points)[0].min()) for o in (Support(), *obstacles)))

    def midsection(self, nodes: Nodes, axis: int = 2) -> tuple[float, float]:
        """Lowest and highest z (or y) of the surface under the middle half of the plate, mm."""
        in_middle = np.abs(self.stage.organ.points_mm[:, 0]) < _PLATE_MM / 4
        there = (self.stage.rows() @ nodes)[in_middle, axis]
        return float(there.min()), float(there.max())


def _faces_down(organ: Mesh, points_mm: Points) -> Bool[np.ndarray, " m"]:
    """Which points of the surface lie on its underside, where it is not too steep."""
    middle, normal = triangles_of(organ.vertices_mm, organ.faces)
    down = -normal[:, 2] > np.linalg.norm(normal, axis=1) / np.hypot(1, _STEEPEST)
    return np.asarray(down[cKDTree(middle).query(points_mm)[1]])


def solve(bench: Bench, name: str, progress: Callable[[str], None] = lambda line: None) -> Deformed:
    """Bring the organ into a state; ``progress``: called with a line before each load step. Raises
    InputError: no such state; TumortrackError: no equilibrium, or the organ's volume changed by
    over 2 %."""
    known([name], STATES)
    organ, solid = bench.stage.organ, bench.stage.solid
    rest = organ.mesh.nodes_mm
    rim_mm = _RIM * float(organ.size_mm[2])
    if name == "D0":
        return Deformed(organ, rest, organ.mesh.tets, rim_mm, None, {"state": name})
    if name in COMPRESSION_MM:
        nodes, about = _press(bench, COMPRESSION_MM[name], progress)
    else:
        nodes, about = (_sink if name == "G1" else _poke)(bench, progress)
    left, right = np.subtract(bench.midsection(nodes, 1), bench.midsection(rest, 1))
    about |= {
        "state": name,
        "sides_outwards_mm": [-float(left), float(right)],
        "volume_change": volume_change(solid, nodes),
        "least_stretch": float(solid.stretch(nodes).min()),
        "largest_displacement_mm": float(np.linalg.norm(nodes - rest, axis=1).max()),
    }
    return Deformed(organ, nodes, organ.mesh.tets, rim_mm, None, about)


def _steps(end_mm: float, step_mm: float) -> list[float]:
    return np.linspace(0, end_mm, max(1, round(end_mm / step_mm)) + 1)[1:].tolist()


def _press(
    bench: Bench, by_mm: float, progress: Callable[[str], None]
) -> tuple[Nodes, dict[str, Any]]:
    nodes = bench.stage.organ.mesh.nodes_mm
    low, high = bench.midsection(nodes)
    half = (_PLATE_MM / 2, 200.0, 10.0)  # wider than any organ
    for amount in _steps(by_mm, _STEP_MM):
        progress(f"plate lowered by {amount:.1f} mm")
        above = ContactPlate((0.0, 0.0, high - amount + half[2]), half, _ROUNDING_MM)
        nodes = bench.load(nodes, above)
    now_low, now_high = bench.midsection(nodes)
    return nodes, {
        "plate_z_mm": high - by_mm,
        "midsection_mm": [high - low, now_high - now_low],
        "plate_load_n": bench.load_n(nodes, above),
        "sunk_in_mm": bench.sunk_in_mm(nodes, above),
    }


def _sink(bench: Bench, progress: Callable[[str], None]) -> tuple[Nodes, dict[str, Any]]:
    """Weight over stiffness grows until the midsection has sunk as far as wanted. Softer tissue and
    more weight are the same problem. One weight is borne already, as the CT shows."""
    nodes = bench.stage.organ.mesh.nodes_mm
    height, added, sunk = bench.midsection(nodes)[1], 4.0, 0.0
    less, more = (0.0, 0.0), (np.inf, np.inf)  # weights added, and how far it sank
    for _ in range(_SINK_STEPS):
        progress(f"softer by {1 + added:.1f}, sunk {sunk:.1f} mm before")
        nodes = bench.load(nodes, weight=added)
        sunk = height - bench.midsection(nodes)[1]
        if abs(sunk - _SINK_MM) < _SINK_TOLERANCE_MM:
            about = {"softer_by": 1 + added, "sunk_mm": sunk}
            return nodes, about | {"sunk_in_mm": bench.sunk_in_mm(nodes)}
        less, more = ((added, sunk), more) if sunk < _SINK_MM else (less, (added, sunk))
        if np.isfinite(more[0]):
            share = (_SINK_MM - less[1]) / (more[1] - less[1])
            added = less[0] + share * (more[0] - less[0])
        else:
            added *= min(2.0, _SINK_MM / max(sunk, 1e-6))
    raise TumortrackError(
        f"G1: the midsection would not sink by {_SINK_MM:g} mm (it sank {sunk:.1f} mm at "
        f"{1 + added:.1f} times the softness)."
    )


def _poke(bench: Bench, progress: Callable[[str], None]) -> tuple[Nodes, dict[str, Any]]:
    nodes, up = bench.stage.organ.mesh.nodes_mm, np.array([0.0, 0.0, 1.0])
    point = poke_point(bench.stage.organ.anatomy)
    for depth in _steps(_POKE_MM, _STEP_MM / 2):
        progress(f"rod pressed in by {depth:.1f} mm")
        rod = Rod(point - depth * up, up, _ROD_MM)
        nodes = bench.load(nodes, rod)
    load_n = bench.load_n(nodes, rod)
    if load_n <= 0:
        raise TumortrackError("P1: the surface slipped past the rod.")
    return nodes, {
        "poke": {"tip_mm": rod.tip_mm.tolist(), "axis": up.tolist(), "radius_mm": _ROD_MM},
        "poke_load_n": load_n,
        "sunk_in_mm": bench.sunk_in_mm(nodes, rod),
    }


def camera_from_bench(above_mm: float, turn_degrees: int = 0) -> Float64[np.ndarray, "4 4"]:
    """Straight down from above the bench's middle, turned about the camera's axis by a multiple of
    90 degrees. Unturned, the picture's right is the bench's x and its down the bench's -y."""
    cosine, sine = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[turn_degrees % 360]
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
    return rigid(turn @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, above_mm]))


def make_scene(bench: Bench, state: Deformed, name: str, view: View, seed: int) -> Scene:
    """One variant's scene in one view, without targets.

    Random numbers depend on seed, variant and view alone. Raises NoEstimate: fewer than 200 points
    of the organ are seen; InputError: no room for background beside the organ.
    """
    rest = state.organ.anatomy
    far_mm = max(_ABOVE_MM, float(state.organ.size_mm[2]) + _NEAREST_MM)  # the support's depth
    to_camera = camera_from_bench(far_mm, VARIANTS[name].turn_degrees)
    on_bench = rest.with_parts(
        part.with_vertices(state.forward(part.vertices_mm)) for part in rest.parts
    )
    reference, camera = transformed(on_bench, to_camera), d405()
    frame = render_depth(reference.organ.vertices_mm, reference.organ.faces, camera)
    shares: dict[str, float] = {}
    if poke := state.about.get("poke"):  # the bench's rod
        tip_mm = transform_points(to_camera, np.array([poke["tip_mm"]], float))[0]
        rod = Rod(tip_mm, to_camera[:3, :3] @ np.array(poke["axis"], float), poke["radius_mm"])
        frame, shares["rod_covers_share"] = occlude(frame, rod)
    rng = np.random.default_rng([seed, list(VARIANTS).index(name), VIEWS.index(view)])
    if view == "noise":
        frame = add_noise(frame, D405_NOISE, rng)
    elif view == "shaft":
        frame, shares["shaft_covers_share"] = occlude(frame, shaft_over(frame, _SHAFT_MM, rng))
    elif view == "clutter":
        frame, shares["background_share"] = add_background(frame, _CLUTTER, far_mm, rng)
    crop = CloudConfig(near_mm=_NEAR_MM, far_mm=far_mm, n_points=5000)
    meta = {
        "variant": name,
        "view": view,
        "seed": seed,
        "state": state.about,
        "camera_from_ct": (to_camera @ bench.bench_from_ct).tolist(),
        "camera_from_bench": to_camera.tolist(),
        "crop_mm": [_NEAR_MM, far_mm],
        "seen": shares,
    }
    return Scene(cloud_from_depth(frame, crop, rng), reference, frame, meta)


def make_scenes(
    case_folder: Path,
    out: Path,
    variants: Sequence[str] = USUAL,
    views: Sequence[View] = VIEWS,
    seed: int = 0,
    report: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Make the scenes of these variants in these views, unless they are there; returns their
    folders. A killed run loses the present state or scene. ``report`` gets lines of progress.

    Raises InputError: no case, an unknown variant or view, ``out`` holds something else, or scenes
    made from another case or seed; TumortrackError: a state has no equilibrium; StorageError.
    """
    wanted = [(v, w) for v in known(variants, VARIANTS) for w in known(views, VIEWS)]
    case = load_case(case_folder)
    identity = {"case_sha256": store.sha256_of(case_folder / store.MANIFEST), "seed": seed}
    identity |= {"targets": TARGETS, "edge_mm": EDGE_MM}
    claim(out, "twin.json", identity)
    todo = [(v, w) for v, w in wanted if not (out / f"{v}-{w}").exists()]
    if todo:
        report("bench: filling the organ with tetrahedra")
        bench = Bench.from_anatomy(case.anatomy, case.up_lps, out / TETS)
        inner = draw_targets(case.anatomy, seed)
    done = 0
    for name in dict.fromkeys(VARIANTS[v].state for v, _ in todo):
        state = solve(bench, name, report)
        there = state.forward(transform_points(bench.bench_from_ct, inner.points_ct))
        for variant, view in todo:
            if VARIANTS[variant].state == name:
                scene = make_scene(bench, state, variant, view, seed)
                to_camera = np.array(scene.meta["camera_from_bench"])
                targets = inner.at(transform_points(to_camera, there))
                scene = replace(scene, meta={**identity, **scene.meta}, targets=targets)
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
    """Depth image, and the cloud over the truth's outlines from the camera and from the side."""
    assert scene.depth is not None
    depth_mm, (near, far) = scene.depth.depth_mm, scene.meta["crop_mm"]
    shown = np.where((depth_mm > near) & (depth_mm < far), depth_mm, np.float32(np.nan))
    depth = depth_picture(scene.depth.with_depth(shown))
    panels = [(f"depth image, cropped to {near:g} .. {far:g} mm", depth), *scene_views(scene, {})]
    legend = {"truth (outline)": colours.TRUTH, "observed points": colours.SEEN}
    words = f"{scene.meta['variant']}, {scene.meta['view']}"
    write_sheet(path, [], [words], legend, [panels])
