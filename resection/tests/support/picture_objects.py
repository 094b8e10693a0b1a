"""What pictures and films of plans are tested with: an ellipsoid with a tumor on top; a plan with
two facets, and one as the paper has it; a workcell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from tumortrack.core.colours import sweep_colour
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.live.values import Polyline, RigidShape, Workcell
from tumortrack_resection.facets import Tools
from tumortrack_resection.strokes import trimmed
from tumortrack_resection.sweeps import Lines
from tumortrack_resection.values import Cut, Located, ResectionPlan

CENTRE, RADII = np.array([0.0, 0.0, 145.0]), np.array([55.0, 30.0, 25.0])
TUMOR, TUMOR_MM = np.array([18.0, -6.0, 163.0]), 14.0
TOOLS, KEPT_MM = Tools(), 5.0


def solid(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(shape.vertices, shape.faces)


def ellipsoid(centre: np.ndarray, radii: np.ndarray | float, fine: int = 3) -> Mesh:
    ball = trimesh.creation.icosphere(fine)
    return Mesh(ball.vertices * radii + centre, ball.faces)


def ring(radius_mm: float, height_mm: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 90)
    x, y = TUMOR[:2, None] + radius_mm * np.stack([np.cos(turn), np.sin(turn)])
    return np.stack([x, y, np.full(90, height_mm)], axis=1)


@pytest.fixture(scope="module")
def located() -> Located:
    tumor = ellipsoid(TUMOR, TUMOR_MM, 4)
    kidney = mesh_of(solid_of(ellipsoid(CENTRE, RADII), "organ") + solid_of(tumor, "tumor"))
    points = np.random.default_rng(0).uniform(*kidney.box_mm, (20_000, 3))
    in_tumor = np.linalg.norm(points - TUMOR, axis=1) < TUMOR_MM
    in_organ = np.linalg.norm((points - CENTRE) / RADII, axis=1) < 1
    labels = np.where(in_tumor, 2, np.where(in_organ, 1, 0)).astype(np.uint8)
    return Located(points[labels > 0], labels[labels > 0], {"kidney": kidney, "tumor_1": tumor})


@pytest.fixture(scope="module")
def plan(located: Located) -> ResectionPlan:
    """A trough along y: two facets at 45 degrees, which meet below the tumor. It opens upwards."""
    normals = np.array([[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0]]) / np.sqrt(2)
    away_mm = TUMOR_MM + KEPT_MM + TOOLS.radius_mm
    planes = np.column_stack([normals, normals @ TUMOR + away_mm])
    y = np.linspace(-36, 36, 73)
    edge = np.column_stack([np.full(73, TUMOR[0]), y, np.full(73, TUMOR[2] - np.sqrt(2) * away_mm)])
    axes = np.array([[1.0, 0.0, -1.0], [-1.0, 0.0, -1.0]]) / np.sqrt(2)
    organ = solid_of(located.organ, "organ")
    return ResectionPlan(
        method="margin",
        tumor="tumor_1",
        label=2,
        grasp_mm=TUMOR + [0, 0, TUMOR_MM],
        cuts=tuple(Cut(n, edge, axis) for n, axis in enumerate(axes, start=1)),
        piece=mesh_of(trimmed(organ, planes, TOOLS.radius_mm)),
        taken=("tumor_1",),
        keep_mm={},
        facets=planes,
        lift=np.array([0.0, 0.0, 1.0]),
        margin_mm=KEPT_MM,
        volumes_ml={
            "organ": 180.0,
            "parenchyma": 168.5,
            "tumor": 11.5,
            "piece": 20.0,
            "healthy": 8.5,
            "kerf": 2.5,
        },
        exophytic=0.5,
    )


@pytest.fixture(scope="module")
def published(plan: ResectionPlan, located: Located) -> ResectionPlan:
    """Two rings, as the paper has them; the instrument is level, in any direction."""
    prism = solid_of(solid(trimesh.creation.cylinder(19.0, 60.0)), "prism")
    prism = prism.translate((TUMOR + [0, 0, 16.0]).tolist())
    cuts = Cut(1, ring(19.0, 160.0)), Cut(2, ring(19.0, 149.0))
    piece = mesh_of(solid_of(located.organ, "organ") ^ prism)
    return replace(plan, method="published", cuts=cuts, piece=piece, facets=np.zeros((0, 4)))


@pytest.fixture(scope="module")
def level() -> Lines:
    """An instrument that comes from the right on both rings."""
    tips = np.concatenate([ring(19.0, 160.2), ring(19.0, 149.1)])
    return np.stack([tips, tips + [TOOLS.electrode_mm, 0.0, 0.0]], axis=1)


@pytest.fixture(scope="module")
def workcells(published: ResectionPlan) -> list[Workcell]:
    """A table, and two arms of which one comes nearer to the organ."""
    table = solid(trimesh.creation.box((900, 600, 20)))
    rod = solid(trimesh.creation.cylinder(20, 300))
    cuts = tuple(
        Polyline(f"cut/{c.sweep}", c.path_mm, sweep_colour(c.sweep, 2)) for c in published.cuts
    )
    grey, frames = (180, 190, 200), []
    for n in range(6):
        places = {
            "table": rigid(np.eye(3), np.array([0.0, 0.0, -10.0])),
            "holder/rod": rigid(np.eye(3), np.array([-300.0, 0.0, 150.0])),
            "cutter/rod": rigid(np.eye(3), np.array([300.0 - 30 * n, 0.0, 150.0])),
        }
        shapes = tuple(
            RigidShape(name, table if name == "table" else rod, place, grey)
            for name, place in places.items()
        )
        frames.append(Workcell("approach" if n < 3 else "sweep 1", None, {}, shapes, cuts))
    return frames
