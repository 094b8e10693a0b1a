"""A small bench: an ellipsoid with two tumors on a base with beads, its case, kit, CT and depth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from tumortrack.case.surface import surfaces
from tumortrack.core.camera import d405
from tumortrack.core.config import to_builtins
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.render import render_depth
from tumortrack.core.store import MANIFEST, new_folder, sha256_of, write_atomically, write_json
from tumortrack.core.types import DepthFrame, LabelVolume, Mesh, Volume
from tumortrack.io.case import Case, save_case
from tumortrack.io.depth_files import depth_png, intrinsics_json
from tumortrack.io.mesh_files import write_mesh
from tumortrack.io.nifti import write_volume_nifti
from tumortrack.simulation.noise import D405_NOISE, NoiseConfig, add_noise
from tumortrack_experiment.kit_file import Bead, Kit, KitPart

BEADS_MM = np.array(
    [[-48, -30, 10], [-44, 33, 18], [3, 41, 12], [50, 30, 15], [47, -33, 20], [6, -40, 14.0]]
)
BEAD_MM = 6.0
# Organ and tumors at rest, base frame: middle and half axes; the organ's foot is at z = 0.
ORGAN = np.array([0, 0, 15.0]), np.array([30, 20, 15.0])
TUMORS = (np.array([14, 4, 20.0]), 8.0), (np.array([-13, -3, 14.0]), 6.0)
BASE_FROM_CT = rigid(
    np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]]), np.array([4.0, -7.0, 11.0])
)  # anterior is up
PLATE = np.array([[-62, -52, -5], [62, 52, 0.0]])
TABLE = np.array([[-70, -60, -9], [70, 60, -5.0]])
PRESS = np.array([[-20, 19.6, 1], [20, 22.6, 35.0]])  # a plate of the state D1, at the organ
STRETCH = np.array([1.06, 0.96, 1 / (1.06 * 0.96)])  # of the state D1: keeps the volume


def camera_from_base(
    distance_mm: float = 150.0, shift_mm: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    turn = Rotation.from_euler("xyz", [188, 7, 4], degrees=True).as_matrix()
    return rigid(turn, np.array([0, 0, distance_mm]) + shift_mm - turn @ [0, 0, 15])


def box_mesh(corners_mm: np.ndarray) -> Mesh:
    box = trimesh.creation.box(bounds=corners_mm)
    return Mesh(box.vertices, box.faces)


@dataclass(frozen=True)
class State:
    """The organ is stretched about its foot; what else is on the base, and where beads are."""

    stretch: np.ndarray = field(default_factory=lambda: STRETCH)
    press: bool = True
    beads_mm: np.ndarray = field(default_factory=lambda: BEADS_MM)
    tumors: tuple[tuple[np.ndarray, float], ...] = TUMORS
    slab: bool = False  # beside the organ, of its HU, that no kit knows
    pins: tuple[
        tuple[float, float, float], ...
    ] = ()  # middles at rest, base frame, of 3 mm beads cast into the organ


def labels_of(points_mm: np.ndarray, state: State) -> np.ndarray:
    """0, 1, 2, 3 at points of the base frame."""
    rest = points_mm / state.stretch
    labels = ((((rest - ORGAN[0]) / ORGAN[1]) ** 2).sum(-1) < 1).astype(np.uint8)
    for number, (middle, radius) in enumerate(state.tumors, 2):
        labels[((rest - middle) ** 2).sum(-1) < radius**2] = number
    return labels


def a_case(folder: Path) -> Case:
    """At rest, 1 mm voxels, LPS."""
    low = np.array([-36, -26, -6.0])
    index = np.indices((72, 52, 42)).reshape(3, -1).T
    ct_from_base = np.linalg.inv(BASE_FROM_CT)
    base_from_index = rigid(np.eye(3), low)
    labels = labels_of(index + low, State(np.ones(3)))
    volume = LabelVolume(labels.reshape(72, 52, 42), ct_from_base @ base_from_index)
    case = Case(surfaces(volume)[0], volume, (0.0, -1.0, 0.0))
    with new_folder(folder) as aside:
        save_case(case, aside)
    return case


def a_kit(folder: Path, case_folder: Path, case: Case, beads_mm: np.ndarray = BEADS_MM) -> Kit:
    rows = tuple(map(tuple, np.eye(4).tolist()))
    parts = [("base", PLATE, ""), ("D1-plate", PRESS, "D1")]
    kit = Kit(
        case_sha256=sha256_of(case_folder / MANIFEST),
        bead_diameter_mm=BEAD_MM,
        beads=tuple(
            Bead(name=f"B{n}", center_mm=tuple(at)) for n, at in enumerate(beads_mm.tolist(), 1)
        ),
        base_from_ct=tuple(map(tuple, BASE_FROM_CT.tolist())),
        organ_ml=case.anatomy.organ.volume_mm3 / 1000,
        tumors_ml=tuple(tumor.volume_mm3 / 1000 for tumor in case.anatomy.tumors),
        parts=tuple(
            KitPart(
                name=name, file=f"{name}.stl", purpose="", volume_ml=1.0, base_from_part=rows,
                state=state,
            )
            for name, _, state in parts
        ),
    )  # fmt: skip
    folder.mkdir()
    for name, corners_mm, _ in parts:
        write_mesh(folder / f"{name}.stl", box_mesh(corners_mm))
    write_json(folder / "kit.json", to_builtins(kit))
    return kit


def a_scan(
    state: State,
    ct_from_base: np.ndarray,
    spacing_mm: float = 1.2,
    bead_hu: float = 9000.0,
    seed: int = 0,
) -> Volume:
    """The bench in a virtual scanner: each shape is blurred by the scanner and its voxels."""
    sigma = np.sqrt(0.65**2 + spacing_mm**2 / 12)
    turn = Rotation.from_euler("xyz", [4, -3, 9], degrees=True).as_matrix()
    low, high = np.array([-66, -58, -12.0]), np.array([66, 58, 50.0])
    shape = np.ceil((high - low) / spacing_mm).astype(int)
    base_from_index = rigid(turn, low) @ np.diag([spacing_mm] * 3 + [1])
    base_from_index[:3, 3] += turn @ (turn.T @ [0, 0, 19] - [0, 0, 19])
    at = transform_points(base_from_index, np.indices(shape).reshape(3, -1).T.astype(float))
    hu = np.full(len(at), -1000.0)

    def paint(inside_mm: np.ndarray, value: float) -> None:
        share = ndtr(inside_mm / sigma)
        hu[:] = hu * (1 - share) + value * share

    def box(corners_mm: np.ndarray) -> np.ndarray:
        return np.minimum(at - corners_mm[0], corners_mm[1] - at).min(1)

    paint(box(TABLE), -80)
    paint(box(PLATE), 100)
    if state.press:
        paint(box(PRESS), 100)
    if state.slab:
        paint(box(np.array([[-25, -34, 0.5], [25, -18, 26.0]])), 40)
    organ = ORGAN[1] * state.stretch
    scaled = (at - ORGAN[0] * state.stretch) / organ
    length = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / organ, axis=1) / np.maximum(length, 1e-9)
    paint((1 - length) / np.maximum(slope, 1e-6), 40)
    for middle, radius in state.tumors:
        away = np.linalg.norm(at / state.stretch - middle, axis=1)
        paint(radius - away, 570)
    for bead in state.beads_mm:
        paint(np.minimum(4.0 - np.hypot(*(at - bead)[:, :2].T), bead[2] - 1.5 - at[:, 2]), 100)
        paint(BEAD_MM / 2 - np.linalg.norm(at - bead, axis=1), bead_hu)
    for pin in state.pins:
        paint(1.5 - np.linalg.norm(at - np.array(pin) * state.stretch, axis=1), bead_hu)
    hu += np.random.default_rng(seed).normal(0, 14, len(hu))
    whole = np.clip(np.rint(hu), -1024, 3071).astype(np.float32).reshape(shape)
    return Volume(whole, ct_from_base @ base_from_index)


def write_scan(path: Path, volume: Volume) -> Path:
    write_volume_nifti(path, volume.hu, volume.lps_from_index)
    return path


def a_view(
    state: State, pose: np.ndarray, case: Case, seed: int = 0, noise: NoiseConfig = D405_NOISE
) -> DepthFrame:
    """What a D405 sees of the bench."""
    organ = case.anatomy.organ
    organ_mm = transform_points(BASE_FROM_CT, organ.vertices_mm) * state.stretch
    solids = [box_mesh(TABLE), box_mesh(PLATE), organ.with_vertices(organ_mm)]
    if state.press:
        solids.append(box_mesh(PRESS))
    for bead in state.beads_mm:
        ball = trimesh.creation.icosphere(3, BEAD_MM / 2)
        post = trimesh.creation.cylinder(4.0, bead[2] - 1.5, sections=24)
        solids += [
            Mesh(ball.vertices + bead, ball.faces),
            Mesh(post.vertices + [bead[0], bead[1], (bead[2] - 1.5) / 2], post.faces),
        ]
    counts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in solids)])
    vertices = np.concatenate([mesh.vertices_mm for mesh in solids])
    faces = np.concatenate([mesh.faces + n for mesh, n in zip(solids, counts, strict=False)])
    frame = render_depth(transform_points(pose, vertices), faces, d405(640, 360))
    return add_noise(frame, noise, np.random.default_rng(seed))


def write_view(folder: Path, frame: DepthFrame) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "depth.png", depth_png(frame))
    write_json(folder / "intrinsics.json", intrinsics_json(frame.intrinsics))
    return folder
