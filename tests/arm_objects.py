"""A kidney-like ellipsoid with a tumor at its side, and a plan to cut it out in two sweeps."""

import numpy as np
import trimesh

from tumortrack.core.types import Mesh
from tumortrack.plan.values import Cut, Layer, ResectionPlan

HALF_MM = np.array([55.0, 30.0, 25.0])
STAND_MM = 120.0
TUMOR_MM = 12.0  # radius


def organ(shift_mm=(0.0, 0.0, 0.0), angle_rad=0.6):
    """The ellipsoid united with the tumor, lowest point on the stand."""
    import manifold3d

    body = manifold3d.Manifold.sphere(1.0, 48).scale(HALF_MM.tolist())
    tumor = manifold3d.Manifold.sphere(TUMOR_MM, 32).translate(_tumor(angle_rad).tolist())
    both = (body + tumor).translate([0.0, 0.0, STAND_MM + HALF_MM[2]]).to_mesh64()
    return Mesh(both.vert_properties[:, :3] + np.array(shift_mm), both.tri_verts)


def _tumor(angle_rad):
    return np.array([np.cos(angle_rad), np.sin(angle_rad), 0.1]) * HALF_MM


def plan(shift_mm=(0.0, 0.0, 0.0), angle_rad=0.6, radius_mm=17.0, step_mm=1.5):
    """Closed contours around the tumor at its middle and at its underside."""
    centre = _tumor(angle_rad) + [0.0, 0.0, STAND_MM + HALF_MM[2]] + np.array(shift_mm)
    angles = np.linspace(0, 2 * np.pi, int(2 * np.pi * radius_mm / step_mm) + 1) + angle_rad
    ring = centre[:2] + radius_mm * np.stack([np.cos(angles), np.sin(angles)], 1)
    low, top = centre[2] - TUMOR_MM, centre[2] + TUMOR_MM
    cuts = tuple(
        Cut(n, np.column_stack([ring, np.full(len(ring), height)]))
        for n, height in ((1, centre[2]), (2, low))
    )
    layers = (Layer(centre[2], np.inf, (ring[:-1],)), Layer(low, centre[2], (ring[:-1],)))
    grasp = np.append(centre[:2], top)
    return ResectionPlan("published", "tumor_1", 2, grasp, cuts, layers, 5.0, {}, 0.5)


def sphere(radius_mm, centre_mm):
    ball = trimesh.creation.icosphere(3, radius_mm)
    return Mesh(np.array(ball.vertices) + centre_mm, ball.faces)
