"""A small organ of the wider world: an ellipsoid with a tumor inside."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import trimesh

from tumortrack.core.types import Anatomy, LabelVolume, Mesh
from tumortrack.io.case import Case
from tumortrack_benchmarks.physics.organ import Organ
from tumortrack_benchmarks.physics.scenes import StressConfig, StressScenes
from tumortrack_benchmarks.physics.tets import tetrahedralise

Vector = tuple[float, float, float]


def ellipsoid(half_mm: Vector, centre_mm: Vector = (0.0, 0.0, 0.0)) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    return Mesh(sphere.vertices * half_mm + centre_mm, sphere.faces)


ANATOMY = Anatomy((ellipsoid((42.0, 24.0, 20.0), (0, 0, 20)), ellipsoid((7, 7, 7), (22, 0, 24))))


@cache
def organ() -> Organ:
    return Organ.from_anatomy(ANATOMY, tetrahedralise(ANATOMY.organ, 9.0, 0.01))


def world(**options: Any) -> StressScenes:
    turned = Anatomy(
        tuple(p.with_vertices(p.vertices_mm + [30.0, -40.0, 100.0]) for p in ANATOMY.parts)
    )
    labels = LabelVolume(np.ones((2, 2, 2), np.uint8), np.diag([1.0, 1.0, 3.0, 1.0]))
    config = StressConfig(**{"families": ("rest",), **options})
    return StressScenes.from_case(
        Case(turned, labels, (0.0, 0.0, 1.0)), "0123abcd", config, organ().mesh
    )
