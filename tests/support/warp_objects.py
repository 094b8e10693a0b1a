"""The elastic objects' organ as an `elastic` model knows it, and a model made in seconds."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from elastic_objects import SMALL, UP, organ
from tumortrack.core.types import Anatomy
from tumortrack.io.model_folder import save_model
from tumortrack.organ.body import build_body
from tumortrack.organ.rest_shape import DistanceField, RestShape, distances_of
from tumortrack.registration.config import GaussNewtonConfig, RegistrationConfig
from tumortrack.registration.gauss_newton import GaussNewton, RegistrationResult, refine
from tumortrack.registration.model import build_model
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.registration import Registration
from tumortrack.registration.search import PosePrior
from tumortrack.simulation.deform import ElasticConfig
from tumortrack.simulation.scene import SceneConfig

ANATOMY: Anatomy = organ()
TURNED = Rotation.from_euler("xyz", [95, 10, 35], degrees=True).as_matrix()
PLACE_MM = np.array([8.0, -5.0, 170.0])


def shape_of(anatomy: Anatomy) -> RestShape:
    """With a body that is quickly made."""
    return RestShape(anatomy, build_body(anatomy, UP, SMALL, 3), distances_of(anatomy))


@cache
def shape() -> RestShape:
    return shape_of(ANATOMY)


def placed(state: int = 73, share: float = 1.0) -> ElasticMotion:
    """The organ before a camera, in a share of one of its library's states."""
    coefficients = share * shape().body.states[state].astype(float)
    return ElasticMotion(shape(), TURNED, PLACE_MM, coefficients)


def nudged(motion: ElasticMotion, shift_mm: ArrayLike, turn_rad: ArrayLike) -> ElasticMotion:
    """Another place for the undeformed organ, to start from."""
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    mean = motion.shape.body.mean
    return ElasticMotion(
        motion.shape, motion.rotation @ turn, motion.centre_mm + np.array(shift_mm), mean
    )


def with_slope(field: DistanceField, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A field's distances at points (n, 3), and their slopes, both trilinear."""
    nodes = np.arange(2)
    distances, slopes = np.empty(len(points)), np.empty((len(points), 3))
    for n, point in enumerate(points):
        place = (point - field.origin_mm) / field.spacing_mm
        place = np.clip(place, 0, np.array(field.values_mm.shape) - 1.001)
        cell = place.astype(int)
        values = field.values_mm[tuple(slice(start, start + 2) for start in cell)].astype(float)
        shares = 1 - np.abs(nodes - (place - cell)[:, None])  # of both nodes, along each axis
        distances[n] = np.einsum("ijk,i,j,k", values, *shares)
        for axis in range(3):
            along = [*shares[:axis], np.array([-1, 1]) / field.spacing_mm, *shares[axis + 1 :]]
            slopes[n, axis] = np.einsum("ijk,i,j,k", values, *along)
    return distances, slopes


def refined(points_mm, start, config=GaussNewtonConfig()) -> RegistrationResult:  # noqa: B008
    """The fit of this organ to one camera's points."""
    return refine(shape(), MultiViewCloud.from_points([points_mm]), start, config)


def descent(points_mm, start, config=GaussNewtonConfig(), moved=None) -> GaussNewton:  # noqa: B008
    """The same, before its first step."""
    return GaussNewton(shape(), MultiViewCloud.from_points([points_mm]), start, config, moved)


def method(config: GaussNewtonConfig | None = None, tilt_degrees: float = 30.0) -> Registration:
    """The registration of this organ."""
    prior = PosePrior(np.array(UP), tilt_degrees)
    return Registration(shape(), config or GaussNewtonConfig(), prior)


def slim_elastic() -> RegistrationConfig:
    """A small body and clean, small pictures: a model is made in seconds."""
    scene = SceneConfig(width=212, height=120, deform=(ElasticConfig(body=SMALL),))
    return RegistrationConfig(scene=scene, scenes=24, searched=12)


def write_slim(folder: Path) -> None:
    """Write a model folder of the slim elastic."""
    folder.mkdir()
    save_model(build_model(ANATOMY, UP, slim_elastic()), folder)
