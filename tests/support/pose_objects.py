"""Rigid organs in known poses, and the points that a camera sees of them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from elastic_objects import UP
from tumortrack.core.camera import d405
from tumortrack.core.geometry import Affine, rotation_onto, transform_points
from tumortrack.core.render import render_depth
from tumortrack.organ.rest_shape import RestShape
from tumortrack.registration.motion import ElasticMotion

CAMERA = d405(212, 120)
PLACE_MM = np.array([6.0, -4.0, 160.0])
OVER = Rotation.from_euler("y", 180, degrees=True)  # the other side up


def lying(
    rest: RestShape, turn_degrees: float, tilt_degrees: tuple[float, float] = (0.0, 0.0)
) -> ElasticMotion:
    """The undeformed organ, turned about the line of sight and tilted about y and x across it."""
    facing = rotation_onto(np.array(UP), np.array([0.0, 0.0, -1.0]))
    angles = [*tilt_degrees, turn_degrees]
    turn = Rotation.from_euler("YXZ", angles, degrees=True).as_matrix()
    return ElasticMotion(rest, turn @ facing, PLACE_MM, rest.body.mean)


def seen(
    motion: ElasticMotion, hidden: float = 0.0, camera_from_view: Affine | None = None
) -> np.ndarray:
    """Points (n, 3) of the side before a camera, its frame, 0.2 mm of noise; without the share of
    them at one end of the organ."""
    into = np.eye(4) if camera_from_view is None else np.linalg.inv(camera_from_view)
    organ = motion.shape.anatomy_ct.organ
    places = transform_points(into, motion.forward(organ.vertices_mm))
    depth_mm = render_depth(places, organ.faces, CAMERA).depth_mm
    row, column = np.nonzero(np.isfinite(depth_mm))
    z = depth_mm[row, column].astype(float)
    x, y = (column - CAMERA.cx) / CAMERA.fx * z, (row - CAMERA.cy) / CAMERA.fy * z
    points = np.column_stack([x, y, z])
    along = points @ into[:3, :3] @ motion.rotation @ motion.shape.long_axis_mm
    points, rng = points[along >= np.quantile(along, hidden)], np.random.default_rng(0)
    points = rng.permutation(points + rng.normal(0, 0.2, points.shape))
    return points[:1500].astype(np.float32)
