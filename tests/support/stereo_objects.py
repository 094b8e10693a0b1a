"""A stereo endoscope that looks at an organ on a table: both pictures rendered, with textures that
are painted onto the bodies, through lenses with distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from tumortrack.core.camera import deproject_pixels
from tumortrack.core.geometry import rigid, rotation_onto, transform_points
from tumortrack.core.render import render_depth
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh
from tumortrack_devices.stereo import StereoCalibration

_GRID_MM, _SIDE = 1.2, 96  # of the texture, which repeats
_MARGIN_PX = 60  # rendered around a picture, for its lens to bend in


def endoscope(width: int = 640, height: int = 480, focal_px: float = 520.0) -> StereoCalibration:
    """About as a surgical robot's, at half its resolution: 4.4 mm between two lenses that squint a
    little and bend."""
    matrix = [[focal_px, 0, width / 2 + 4.0], [0, focal_px * 1.01, height / 2 - 3.0], [0, 0, 1]]
    other = [[focal_px * 1.02, 0, width / 2 - 6.0], [0, focal_px, height / 2 + 5.0], [0, 0, 1]]
    turn = Rotation.from_euler("xyz", [0.3, 0.6, -0.4], degrees=True).as_matrix()
    return msgspec.convert(
        {
            "width": width,
            "height": height,
            "K1": matrix,
            "D1": [-0.12, 0.05, 0.001, -0.0005, 0.0],
            "K2": other,
            "D2": [-0.10, 0.03, -0.0008, 0.0006, 0.0],
            "R": turn.tolist(),
            "T": [-4.4, 0.06, 0.1],
        },
        StereoCalibration,
    )


@dataclass(frozen=True, eq=False)
class StereoScene:
    """Bodies before the left camera, mm: their surfaces, and base colours (RGB). ``contrast``: of
    the texture, grey levels; ``noise``: of the pictures."""

    bodies: tuple[Mesh, ...]
    colours: tuple[tuple[int, int, int], ...]
    contrast: float = 25.0
    noise: float = 2.0
    seed: int = 0

    def pictures(self, calibration: StereoCalibration) -> tuple[np.ndarray, np.ndarray]:
        """Left and right, as the cameras give them."""
        left = self._picture(calibration.K1, calibration.D1, calibration, np.eye(4))
        right_from_left = rigid(np.array(calibration.R), np.array(calibration.T))
        return left, self._picture(calibration.K2, calibration.D2, calibration, right_from_left)

    def depth(self, camera: Intrinsics, camera_from_left: np.ndarray) -> DepthFrame:
        """The true depth image of a pinhole camera."""
        every = [self.depth_of(n, camera, camera_from_left) for n in range(len(self.bodies))]
        return DepthFrame(np.fmin.reduce([frame.depth_mm for frame in every]), camera)

    def depth_of(self, n: int, camera: Intrinsics, camera_from_left: np.ndarray) -> DepthFrame:
        """Of one of the bodies, alone."""
        body = self.bodies[n]
        placed_mm = transform_points(camera_from_left, body.vertices_mm)
        return render_depth(placed_mm, body.faces, camera)

    def _picture(
        self,
        matrix: ArrayLike,
        distortion: ArrayLike,
        calibration: StereoCalibration,
        camera_from_left: np.ndarray,
    ) -> np.ndarray:
        k, wide = np.array(matrix), 2 * _MARGIN_PX
        camera = Intrinsics(
            calibration.width + wide,
            calibration.height + wide,
            *(k[0, 0], k[1, 1], k[0, 2] + _MARGIN_PX, k[1, 2] + _MARGIN_PX),
        )
        picture = self._flat(camera, camera_from_left)
        u, v = np.meshgrid(np.arange(calibration.width), np.arange(calibration.height))
        pixels = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
        flat = cv2.undistortPoints(pixels, k, np.array(distortion), None, None, k).reshape(-1, 2)
        x, y = (flat + _MARGIN_PX).T.astype(np.float32).reshape(2, *u.shape)
        bent = cv2.remap(picture, x, y, cv2.INTER_CUBIC)
        chance = np.random.default_rng((self.seed, int(camera_from_left[0, 3] * 1000) % 1000))
        noisy = bent + chance.normal(0, self.noise, bent.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def _flat(self, camera: Intrinsics, camera_from_left: np.ndarray) -> np.ndarray:
        """The picture (h, w, 3) of the undistorted camera, float32."""
        chance = np.random.default_rng(self.seed)
        fine = chance.normal(size=(_SIDE,) * 3)
        field = sum(
            octave / octave.std()
            for octave in (gaussian_filter(fine, s, mode="wrap") for s in (0.7, 3.0))
        ) / np.sqrt(2)
        out = np.full((camera.height * camera.width, 3), 10.0, np.float32)
        nearest = np.full(camera.height * camera.width, np.inf)
        back = np.linalg.inv(camera_from_left)
        for n, colour in enumerate(self.colours):
            depth_mm = self.depth_of(n, camera, camera_from_left).depth_mm.ravel().astype(float)
            here = np.flatnonzero(depth_mm < nearest)  # NaN is not
            nearest[here] = depth_mm[here]
            points_mm = deproject_pixels(here, depth_mm[here], camera).astype(float)
            places = transform_points(back, points_mm) / _GRID_MM
            texture = map_coordinates(field, places.T, order=1, mode="grid-wrap")
            out[here] = np.array(colour) + self.contrast * texture[:, None]
        picture = out.reshape(camera.height, camera.width, 3)
        return cv2.GaussianBlur(picture, (0, 0), 0.7)


def over_a_table(organ: Mesh, left_from_ct: np.ndarray, **view: Any) -> StereoScene:
    """The organ as it is placed, red, above a blue table."""
    placed = Mesh(transform_points(left_from_ct, organ.vertices_mm), organ.faces)
    below = table(placed.box_mm[1, 2] + 3)
    return StereoScene((placed, below), ((150, 70, 60), (60, 90, 120)), **view)


def table(depth_mm: float, tilt_degrees: float = 8.0, half_mm: float = 300.0) -> Mesh:
    """A large plane behind it all."""
    corners = half_mm * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    turn = Rotation.from_euler("x", tilt_degrees, degrees=True).as_matrix()
    placed = rigid(turn, np.array([0.0, 0.0, depth_mm]))
    return Mesh(transform_points(placed, corners), np.array([[0, 2, 1], [0, 3, 2]]))


def placed_before(
    organ: Mesh, up_lps: tuple[float, float, float], nearest_mm: float, roll: float
) -> np.ndarray:
    """``left_from_ct`` (4, 4): the organ's upper side faces the left camera, its nearest point so
    far away."""
    turn = rotation_onto(np.array(up_lps), np.array([0.0, 0.0, -1.0]))
    turn = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ turn
    there = organ.vertices_mm @ turn.T
    low, high = there.min(0), there.max(0)
    middle = (low + high) / 2
    return rigid(turn, np.array([-middle[0], -middle[1], nearest_mm - low[2]]))
