"""The elastic objects' organ as a `clinic` model knows it, and a training of seconds."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from elastic_objects import SMALL, UP, organ
from tumortrack.core.types import Anatomy
from tumortrack.models.config import NetworkConfig, TrainConfig
from tumortrack.registration import kernels
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.rest_shape import RestShape, shape_of
from tumortrack.simulate.deform import ElasticConfig
from tumortrack.simulate.elastic.body import build_body
from tumortrack.simulate.elastic.flow import BLOCK, block, steps_for
from tumortrack.simulate.occupancy import OccupancyConfig
from tumortrack.simulate.scene import SceneConfig
from tumortrack.training.presets import clinic, clinic_network
from tumortrack.training.train import TrainingRun, train

ANATOMY: Anatomy = organ()
SCALE_MM = 48.0  # half the organ's length
TURNED = Rotation.from_euler("xyz", [95, 10, 35], degrees=True).as_matrix()
PLACE_MM = np.array([8.0, -5.0, 170.0])


@cache
def shape() -> RestShape:
    return shape_of(ANATOMY, build_body(ANATOMY, UP, SMALL, 3))


def placed(state: int = 73, share: float = 1.0) -> ElasticMotion:
    """The organ before a camera, in a share of one of its library's states."""
    coefficients = share * shape().body.states[state].astype(float)
    return ElasticMotion(shape(), TURNED, PLACE_MM, coefficients)


def nudged(motion, shift_mm, turn_rad):
    """Another place for the undeformed organ, to start from."""
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    mean = motion.shape.body.mean
    return ElasticMotion(
        motion.shape, motion.rotation @ turn, motion.centre_mm + np.array(shift_mm), mean
    )


def residual_rows(points_mm, pose) -> np.ndarray:
    """``kernels.add_rows`` of points at a (rotation, centre_mm, coefficients)."""
    rotation, centre_mm, coefficients = pose
    body = shape().body
    velocity = body.velocity(-coefficients)
    rows = np.empty((len(points_mm), kernels.POSE + len(coefficients) + 1), np.float32)
    spacing_mm = np.float32(body.spacing_mm)
    known = (
        body.modes,
        shape().distances[0],
        kernels.Flow(velocity, body.origin_mm, spacing_mm, steps_for(velocity, body.spacing_mm)),
        kernels.Pose(body.center_ct, rotation, centre_mm),
    )
    points = np.ascontiguousarray(points_mm, np.float32)
    for first in range(0, len(points), BLOCK):
        some = slice(first, first + BLOCK)
        kernels.add_rows(*known, points[some], block(), rows[some])
    return rows


def with_slope(field, points) -> tuple[np.ndarray, np.ndarray]:
    """A field's distances at points (n, 3), and their slopes."""
    lattice = field.values_mm, field.origin_mm, np.float32(field.spacing_mm)
    found = np.array([kernels.distance_at(*lattice, *point) for point in points], np.float32)
    return found[:, 0], found[:, 1:]


def slim_network() -> NetworkConfig:
    return clinic_network(SMALL.modes, SCALE_MM)


def slim_clinic() -> TrainConfig:
    """The preset clinic with a small body and clean, small pictures: learns in seconds."""
    scene = SceneConfig(
        width=212,
        height=120,
        deform=(ElasticConfig(body=SMALL),),
        occupancy=OccupancyConfig(per_side=16, pool=4000),
    )
    return msgspec.structs.replace(
        clinic(ANATOMY),
        scene=scene,
        network=slim_network(),
        batch_size=16,
        validation_pairs=16,
        validation_points=512,
        validate_every=1000,
    )


def train_slim(folder: Path, checkpoint_every_s: float = 30.0) -> None:
    """Write a model folder of the slim clinic."""
    setting = {"steps": 80, "workers": 0, "device": "cpu", "checkpoint_every_s": checkpoint_every_s}
    train(TrainingRun(ANATOMY, UP, "no digest", slim_clinic(), **setting), folder, lambda _: None)
