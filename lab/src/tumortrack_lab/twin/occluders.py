"""The rod before the camera. It is taken to be segmented out: where it hides the organ there is no
return, and it gives none of its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tumortrack.core.geometry import rotation_onto
from tumortrack.core.types import DepthFrame, Mesh
from tumortrack.sense.render import render_depth
from tumortrack_lab.twin.equilibrium import Rod

_RING_MM = 4.0  # a rod is cut into rings: a triangle that reaches behind the camera is not drawn
_LAST_DEPTH_MM = 5.0  # a rod that comes straight at the camera ends here


def rod_mesh(rod: Rod) -> Mesh:
    """The rod's closed surface."""
    import trimesh

    tip, axis, length = rod.tip_mm, rod.axis, rod.length_mm
    if axis[2] < 0:  # towards the camera's plane
        length = min(length, max((_LAST_DEPTH_MM - tip[2]) / axis[2], 3 * rod.radius_mm))
    angle = np.linspace(0, np.pi / 2, 9)
    cap = rod.radius_mm * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    along = np.linspace(rod.radius_mm, length, int(np.ceil(length / _RING_MM)) + 1)[1:]
    side = np.stack([np.full(len(along), rod.radius_mm), along], axis=1)
    profile = np.concatenate([cap, side, [[0.0, length]]])
    solid = trimesh.creation.revolve(profile, sections=48)
    faces = solid.faces if solid.volume > 0 else solid.faces[:, ::-1]
    upright = rotation_onto(np.array([0.0, 0.0, 1.0]), axis)
    return Mesh(solid.vertices @ upright.T + tip, faces)


def occlude(frame: DepthFrame, rod: Rod) -> tuple[DepthFrame, float]:
    """The frame without what the rod hides, and the share of its returns that were lost."""
    mesh, seen = rod_mesh(rod), np.isfinite(frame.depth_mm)
    with np.errstate(invalid="ignore"):
        solid = render_depth(mesh.vertices_mm, mesh.faces, frame.intrinsics)
        hidden = solid.depth_mm < frame.depth_mm
    depth_mm = np.where(hidden, np.float32(np.nan), frame.depth_mm)
    return replace(frame, depth_mm=depth_mm), float(hidden.sum() / max(seen.sum(), 1))
