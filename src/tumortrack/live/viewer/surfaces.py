"""A surface made for the eye: the organ without its tumors' own."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32

from tumortrack.core.mesh_query import surface_distance
from tumortrack.core.types import Anatomy

_SAME_MM = 0.4


def bare_faces(anatomy: Anatomy) -> Int32[np.ndarray, "f 3"]:
    """The organ's triangles that are not a tumor's surface too: where a tumor bulges out of the
    organ both have the same surface, and drawn together they flicker."""
    organ = anatomy.organ
    shared = np.zeros(len(organ.vertices_mm), bool)
    for tumor in anatomy.tumors:
        shared |= surface_distance(tumor, organ.vertices_mm) < _SAME_MM
    return organ.faces[~shared[organ.faces].all(1)]
