"""A simulated bench: a kit's phantom in a state, as a CT scanner and a camera see it.

Base frame, mm (``tumortrack_experiment.kit_file``). The organ is the twin's, at rest in its state;
base, stands and plates are the kit's printed parts, beads are balls in their dimples. Attenuations:
organ and tumors are the scanner's; printed PLA and glass are our choice (PLA somewhat denser than
water; soda-lime glass far brighter than any tumor). Streaks are left out, as in the scanner.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64

from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_files import read_mesh
from tumortrack.core.types import Anatomy, DepthFrame, Intrinsics, LabelVolume, Mesh, Volume
from tumortrack.imaging.raster import label_grid, voxelise
from tumortrack.phantom.scanner import ScannerParameters, scan
from tumortrack.sense.render import render_depth
from tumortrack_experiment.kit_file import Kit
from tumortrack_lab.twin.apparatus import moved
from tumortrack_lab.twin.views import EquilibriumState

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
    state: EquilibriumState,
    name: str,
    moved_mm: dict[str, tuple[float, float, float]] | None = None,
) -> Setup:
    """The kit of ``folder`` with the organ in a state that the kit calls ``name``. ``moved_mm``:
    offsets of beads from their dimples; not finite: the bead is missing."""
    base_from_bench = np.array(kit.base_from_ct) @ np.linalg.inv(state.bench_from_ct)
    printed = []
    for part in kit.parts:
        if part.base_from_part is not None and part.state in ("", name):
            mesh = read_mesh(folder / part.file)
            placed = transform_points(np.array(part.base_from_part), mesh.vertices_mm)
            printed.append(mesh.moved(placed))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=kit.bead_diameter_mm / 2)
    beads = []
    for bead in kit.beads:
        middle = np.array(bead.center_mm) + np.array((moved_mm or {}).get(bead.name, (0, 0, 0)))
        if np.isfinite(middle).all():
            beads.append(Mesh(ball.vertices + middle, ball.faces))
    return Setup(name, moved(state.anatomy, base_from_bench), tuple(printed), tuple(beads))


def scan_bench(
    setup: Setup,
    scanner_from_base: Float64[np.ndarray, "4 4"],
    parameters: ScannerParameters,
    seed: int,
    printed_hu: float = PRINTED_HU,
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
    material_hu = {_PRINTED: printed_hu, _BEAD: BEAD_HU}
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
