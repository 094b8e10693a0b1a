"""Where the organ lies before the camera."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.config import Config
from tumortrack.core.geometry import rigid, rotation_onto
from tumortrack.core.types import Mesh


class PoseConfig(Config, frozen=True):
    """Random poses of the organ.

    ``full``: every rotation, uniformly (the paper's M_full). ``limited``: any rotation about the
    camera's axis, tilts about X and Y uniform within ``tilt_deg`` of the direction that faces
    the camera (the paper's M_lim, section Experiments).
    """

    rotations: Literal["full", "limited"] = "limited"
    tilt_deg: float = 15.0
    nearest_mm: tuple[float, float] = (110.0, 125.0)  # depth of the organ's nearest point
    sideways_mm: float = 15.0  # the organ's centre may lie this far off the camera's axis


def sample_pose(
    config: PoseConfig,
    organ_ct: Mesh,
    up_lps: tuple[float, float, float],
    nearest_mm: tuple[float, float],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "4 4"]:
    """Draw ``camera_from_ct``; the organ's nearest point gets a depth within ``nearest_mm``."""
    if config.rotations == "full":
        rotation = Rotation.random(rng=rng).as_matrix()
    else:
        spin = rng.uniform(0, 360)
        tilt_x, tilt_y = rng.uniform(-config.tilt_deg, config.tilt_deg, 2)
        rotation = _turn(*np.radians([tilt_x, tilt_y, spin])) @ _facing(up_lps)
    rotated = rotation @ organ_ct.vertices_mm.T  # (3, v): minima along rows are fast
    lower, upper = rotated.min(1), rotated.max(1)
    offset = rng.uniform(-config.sideways_mm, config.sideways_mm, 2)
    nearest = rng.uniform(*nearest_mm)
    centre = (lower + upper) / 2
    return rigid(rotation, np.array([*(offset - centre[:2]), nearest - lower[2]]))


def _turn(about_x: float, about_y: float, about_z: float) -> Float64[np.ndarray, "3 3"]:
    """A rotation about z, then y, then x, all fixed axes; radians. (Scipy's Rotation takes a
    twentieth of a scene's time for a single one.)"""
    sx, sy, sz = np.sin([about_x, about_y, about_z]).tolist()
    cx, cy, cz = np.cos([about_x, about_y, about_z]).tolist()
    return np.array(
        [
            [cy * cz, -cy * sz, sy],
            [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
            [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
        ]
    )


@lru_cache(maxsize=64)
def _facing(up_lps: tuple[float, float, float]) -> Float64[np.ndarray, "3 3"]:
    """The rotation that turns the organ's upper side towards the camera."""
    turn = rotation_onto(np.array(up_lps), np.array([0.0, 0.0, -1.0]))
    turn.flags.writeable = False
    return turn
