"""A motion whose both ways are known in closed form, for tests of what is built on motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import rigid, transform_points

CAMERA_FROM_CT = rigid(
    Rotation.from_euler("xyz", [170, 12, 40], degrees=True).as_matrix(), np.array([90.0, -20, 200])
)
WAVE = np.array([0.02, 0.05, 0.01])  # radians per mm
ALONG = np.cross(WAVE, [1.0, 0, 0])  # across the wave, which therefore stays as it is
ALONG /= np.linalg.norm(ALONG)


@dataclass(frozen=True)
class Wave:
    """A smooth sideways wave in the CT, then a rigid pose; volume stays."""

    height_mm: float = 5.0
    sure: bool = False

    def forward(self, points_ct: np.ndarray) -> np.ndarray:
        moved = points_ct + self.height_mm * np.sin(points_ct @ WAVE)[:, None] * ALONG
        return transform_points(CAMERA_FROM_CT, moved)

    def inverse(self, points_camera: np.ndarray) -> np.ndarray:
        moved = transform_points(np.linalg.inv(CAMERA_FROM_CT), points_camera)
        return moved - self.height_mm * np.sin(moved @ WAVE)[:, None] * ALONG

    def std_mm(self, points_ct: np.ndarray) -> np.ndarray | None:
        return 0.5 + np.abs(points_ct[:, 0]) / 100 if self.sure else None

    largest_std_mm = std_mm

    def covariance_mm2(self, points_ct: np.ndarray) -> np.ndarray | None:
        std_mm = self.std_mm(points_ct)
        return None if std_mm is None else std_mm[:, None, None] ** 2 * np.eye(3)
