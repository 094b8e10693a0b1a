"""The rehearsal's bench: a kit's phantom in a state, as a CT scanner and a camera see it, and
boards held before the camera or on a robot's tool, as files that real devices would give.

Base frame, mm (``tumortrack_experiment.kit_file``). The organ is the twin's, at rest in its state;
base, stands and plates are the kit's printed parts, beads are balls in their dimples. Attenuations:
organ and tumors are the scanner's; printed PLA and glass are our choice (PLA somewhat denser than
water; soda-lime glass far brighter than any tumor). Streaks are left out, as in the scanner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core import store
from tumortrack.core.camera import d405
from tumortrack.core.config import Config
from tumortrack.core.geometry import Affine, rigid, transform_points
from tumortrack.core.raster import label_grid, voxelise
from tumortrack.core.render import render_depth
from tumortrack.core.types import Anatomy, DepthFrame, Intrinsics, LabelVolume, Mesh, Volume
from tumortrack.io.depth_files import depth_png, intrinsics_json
from tumortrack.io.mesh_files import read_mesh
from tumortrack.simulation.noise import D405_NOISE, add_noise
from tumortrack.simulation.phantom.dicom import write_dicom_series
from tumortrack.simulation.phantom.scanner import ScannerParameters, scan
from tumortrack_benchmarks.physics.organ import transformed
from tumortrack_experiment.calibrate.board import Board
from tumortrack_experiment.calibrate.lens import lens_of
from tumortrack_experiment.calibrate.virtual_board import (
    board_depth_mm,
    board_picture,
    looks_at_board,
)
from tumortrack_experiment.kit_file import Kit

PRINTED_HU, BEAD_HU = 130.0, 2200.0
_PRINTED, _BEAD = 254, 255  # labels of the virtual CT
_TABLE_MM = (600.0, 500.0)
_CELL_MM = 0.5  # of what is scanned: finer than any scanner's voxel


@dataclass(frozen=True, eq=False)
class Setup:
    """The objects on the bench in one state; base frame, mm."""

    state: str
    anatomy: Anatomy
    printed: tuple[Mesh, ...]
    beads: tuple[Mesh, ...]

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        return (self.anatomy.organ, *self.printed, *self.beads)


def set_up(
    kit: Kit,
    folder: Path,
    truth: Anatomy,
    base_from_truth: Float64[np.ndarray, "4 4"],
    name: str,
    moved_mm: dict[str, tuple[float, float, float]] | None = None,
) -> Setup:
    """The kit of ``folder`` with the organ (any frame) in a state of this name. ``moved_mm``:
    offsets of beads from their dimples; not finite: the bead is missing."""
    printed = []
    for part in kit.parts:
        if part.base_from_part is not None and part.state in ("", name):
            mesh = read_mesh(folder / part.file)
            placed = transform_points(np.array(part.base_from_part), mesh.vertices_mm)
            printed.append(mesh.with_vertices(placed))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=kit.bead_diameter_mm / 2)
    beads = []
    for bead in kit.beads:
        middle = np.array(bead.center_mm) + np.array((moved_mm or {}).get(bead.name, (0, 0, 0)))
        if np.isfinite(middle).all():
            beads.append(Mesh(ball.vertices + middle, ball.faces))
    return Setup(name, transformed(truth, base_from_truth), tuple(printed), tuple(beads))


def scan_bench(
    setup: Setup,
    scanner_from_base: Float64[np.ndarray, "4 4"],
    parameters: ScannerParameters,
    seed: int,
) -> Volume:
    """A CT of the bench in this pose in the scanner (LPS, mm)."""
    corners = np.concatenate([mesh.box_mm for mesh in setup.meshes])
    low = corners.min(0) - 2
    shape = tuple(np.ceil((corners.max(0) + 2 - low) / _CELL_MM).astype(int).tolist())
    base_from_index = rigid(np.eye(3), low) @ np.diag([_CELL_MM] * 3 + [1.0])
    labels = label_grid(setup.anatomy, base_from_index, shape)
    for meshes, label in ((setup.printed, _PRINTED), (setup.beads, _BEAD)):
        for mesh in meshes:
            labels[voxelise(mesh, base_from_index, shape) & (labels == 0)] = label
    material_hu = {_PRINTED: PRINTED_HU, _BEAD: BEAD_HU}
    volume = LabelVolume(labels, scanner_from_base @ base_from_index)
    return scan(volume, parameters, seed, material_hu)


def see_bench(
    setup: Setup, camera_from_base: Float64[np.ndarray, "4 4"], camera: Intrinsics
) -> DepthFrame:
    """The error-free depth image of a camera in this pose; the base is on a table."""
    nearest = np.full((camera.height, camera.width), np.nan, np.float32)
    lowest_mm = min(float(mesh.box_mm[0, 2]) for mesh in setup.meshes)
    table = trimesh.creation.box((*_TABLE_MM, 10.0))
    for mesh in (Mesh(table.vertices + [0, 0, lowest_mm - 5.0], table.faces), *setup.meshes):
        there = transform_points(camera_from_base, mesh.vertices_mm)
        nearest = np.fmin(nearest, render_depth(there, mesh.faces, camera).depth_mm)
    return DepthFrame(nearest, camera)


class BenchErrors(Config, frozen=True, kw_only=True):
    """True errors of the apparatus, which the commands do not know: of the camera's focal length
    and principal point against its own intrinsics, and of its depth, by a factor and an offset.
    Within what D405 owners report at 70 to 200 mm (librealsense #12236, #14204). ``distortion``:
    residual of the rectification, as in OpenCV (k1, k2, p1, p2, k3)."""

    focal: float = 1.004
    centre_px: tuple[float, float] = (1.5, -1.0)
    distortion: tuple[float, float, float, float, float] = (0.004, -0.006, 0.0003, -0.0002, 0.0)
    depth_scale: float = 1.004
    depth_offset_mm: float = 0.3


@dataclass(frozen=True, eq=False)
class Hands:
    """``folder`` is the simulated camera's (``rehearsal.camera``)."""

    folder: Path
    errors: BenchErrors
    camera_from_base: Float64[np.ndarray, "4 4"]

    @property
    def believed(self) -> Intrinsics:
        """The device's own intrinsics."""
        return d405()

    @property
    def true(self) -> Intrinsics:
        """The true intrinsics."""
        camera, focal, (right, down) = self.believed, self.errors.focal, self.errors.centre_px
        fx, fy = camera.fx * focal, camera.fy * focal
        return replace(camera, fx=fx, fy=fy, cx=camera.cx + right, cy=camera.cy + down)

    def plug_in(self) -> None:
        """Connect the camera; it shows nothing yet."""
        self.folder.mkdir(parents=True, exist_ok=True)
        store.write_json(self.folder / "camera.json", intrinsics_json(self.believed))

    def show(self, setup: Setup) -> None:
        """Let the camera see the bench as it is now."""
        frame = see_bench(setup, self.camera_from_base, self.true)
        depth_mm = frame.depth_mm * self.errors.depth_scale + self.errors.depth_offset_mm
        aside = self.folder / "next.npy"
        np.save(aside, depth_mm.astype(np.float32))
        aside.rename(self.folder / "now.npy")

    def scanned(self, setup: Setup, out: Path, seed: int) -> Float64[np.ndarray, "4 4"]:
        """Write a DICOM series of the bench in the scanner; returns ``scanner_from_base``."""
        rng = np.random.default_rng(seed)
        turn = Rotation.from_euler("xyz", rng.uniform(-6, 6, 3) + [90, 0, 0], degrees=True)
        scanner_from_base = rigid(turn.as_matrix(), rng.uniform(-30, 30, 3))
        volume = scan_bench(setup, scanner_from_base, ScannerParameters(), seed)
        write_dicom_series(volume, out, seed, "Phantom on its base")
        return scanner_from_base


def looking_down(above_mm: float, tilt_degrees: tuple[float, float]) -> Float64[np.ndarray, "4 4"]:
    """``camera_from_base`` of a camera over the base, tilted about its own x and y."""
    down = np.diag([1.0, -1.0, -1.0])
    tilt = Rotation.from_euler("xy", tilt_degrees, degrees=True).as_matrix()
    return rigid(tilt @ down, np.array([0.0, 0.0, above_mm]))


# Of a commanded pose; a data sheet's repeatability (0.05 mm of a UR10e) is less than its accuracy.
ROBOT_MM, ROBOT_DEG = 0.1, 0.03
_TWICE = 2  # images of each pose; their difference shows the noise


def hold_board(hands: Hands, board: Board, folder: Path, count: int, seed: int) -> None:
    """Pictures and depth images of a board held by hand, for `calibrate camera`."""
    rng = np.random.default_rng(seed)
    for number, camera_from_board in enumerate(looks_at_board(board, count, rng)):
        for again in range(_TWICE):
            _shoot(hands, board, camera_from_board, folder / f"{number:02d}-{again}", rng)


def move_board(
    hands: Hands, board: Board, robot_from_camera: Affine, folder: Path, count: int, seed: int
) -> None:
    """Pictures of a board on the tool of a robot, and the robot's own poses, for `calibrate
    hand-eye --eye-to-hand`. The robot's poses have the errors of its accuracy."""
    rng = np.random.default_rng(seed)
    tool_from_board = rigid(
        Rotation.from_euler("xyz", rng.uniform(-20, 20, 3), degrees=True).as_matrix(),
        rng.uniform(-40, 40, 3) + [0, 0, 60],
    )
    rows = []
    views = looks_at_board(board, count, rng, (130.0, 230.0))
    for number, camera_from_board in enumerate(views):
        _shoot(hands, board, camera_from_board, folder / f"{number:02d}", rng, depth=False)
        stated = robot_from_camera @ camera_from_board @ np.linalg.inv(tool_from_board)
        wrong = Rotation.from_rotvec(np.radians(rng.normal(0, ROBOT_DEG, 3))).as_matrix()
        stated = stated @ rigid(wrong, rng.normal(0, ROBOT_MM, 3))
        rows.append(stated.tolist())
    poses = folder.with_suffix(".json")
    store.write_json(poses, {"frame_id": "base_link", "unit": "mm", "base_from_tool": rows})


def _shoot(
    hands: Hands,
    board: Board,
    camera_from_board: Affine,
    folder: Path,
    rng: np.random.Generator,
    depth: bool = True,
) -> None:
    errors = hands.errors
    lens = lens_of(hands.true, distortion=errors.distortion)
    folder.mkdir(parents=True)
    picture = board_picture(board, lens, camera_from_board, rng)
    store.write_atomically(folder / "infrared.png", cv2.imencode(".png", picture)[1].tobytes())
    if depth:
        depth_mm = board_depth_mm(board, lens_of(hands.true), camera_from_board)
        measured_mm = depth_mm * errors.depth_scale + errors.depth_offset_mm
        frame = add_noise(DepthFrame(measured_mm, hands.believed), D405_NOISE, rng)
        store.write_atomically(folder / "depth.png", depth_png(frame))
        store.write_json(folder / "intrinsics.json", intrinsics_json(hands.believed))
