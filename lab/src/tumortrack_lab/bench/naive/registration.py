"""A registration frame in the plain way: nearest vertices by a tree, SciPy, inside tests.

The same method: the network's placements both ways round, each fitted to the points by Gauss-Newton
steps to the end, the better one kept; then every query carried back and tested against the CT's
surfaces.
"""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.registration.model import RegistrationModel
from tumortrack.simulate.occupancy import labels_of
from tumortrack_lab.bench.naive.scenes import flowed, sampled

_Fit = tuple[float, np.ndarray, np.ndarray, np.ndarray]  # cost, rotation, centre, coefficients


class NaiveRegistration:
    """Places the organ of one model in clouds (camera frame, mm)."""

    def __init__(self, model: RegistrationModel) -> None:
        self._network, self._config = model.network, model.config.refine
        self._anatomy, self.body = model.shape.anatomy_ct, model.shape.body
        organ = self._anatomy.organ
        self._vertices = organ.vertices_mm
        mesh = trimesh.Trimesh(organ.vertices_mm, organ.faces, process=False)
        self._normals = np.array(mesh.vertex_normals)
        self._tree = cKDTree(organ.vertices_mm)
        modes = np.moveaxis(self.body.modes, (3, 4), (0, 1))
        self._modes = modes.reshape(-1, *modes.shape[2:])

    def labels(self, points_mm: np.ndarray, queries_mm: np.ndarray) -> np.ndarray:
        """A cloud (n, 3) -> labels of queries (q, 3)."""
        with torch.inference_mode():
            found = self._network.flip_hypotheses(torch.tensor(points_mm)[None])
        parts = (found.rotation, found.centre_mm, found.coefficients)
        starts = zip(*(part.double().numpy() for part in parts), strict=True)
        best = min((self._refined(points_mm, *start) for start in starts), key=lambda fit: fit[0])
        return self._labelled(best, queries_mm)

    def labels_where(self, motion_back: np.ndarray) -> np.ndarray:
        """Of places in the CT (n, 3): inside tests on its surfaces."""
        return labels_of(self._anatomy, motion_back.astype(np.float32))

    def _labelled(self, fit: _Fit, queries_mm: np.ndarray) -> np.ndarray:
        _, rotation, centre, coefficients = fit
        moved = (queries_mm - centre) @ rotation + self.body.center_ct
        return self.labels_where(flowed(self.body, -coefficients, moved))

    def _refined(
        self, points: np.ndarray, rotation: np.ndarray, centre: np.ndarray, state: np.ndarray
    ) -> _Fit:
        config, body = self._config, self.body
        modes = len(body.mean)
        prior = np.zeros((6 + modes, 6 + modes))
        prior[:3, :3] = np.eye(3) / config.shift_mm**2
        prior[3:6, 3:6] = np.eye(3) / config.turn_rad**2
        prior[6:, 6:] = body.precision
        weight = min(config.n_effective / len(points), 1.0) / config.sigma_mm**2
        moved, cost = np.zeros(6), np.inf
        for step in range(config.steps):
            width = max(config.last_mm, config.first_mm * config.narrowing**step)
            distance, rows = self._residuals(points, rotation, centre, state)
            pull = 1 / (1 + (distance / width) ** 2) ** 2
            off = np.concatenate([moved, state - body.mean])
            curvature = weight * rows.T @ (pull[:, None] * rows) + prior
            change = -np.linalg.solve(curvature, weight * rows.T @ (pull * distance) + prior @ off)
            square = (distance / config.last_mm) ** 2
            cost = weight * config.last_mm**2 * float((square / (1 + square)).sum())
            cost += float(off @ prior @ off)
            centre = centre + rotation @ change[:3]
            rotation = rotation @ Rotation.from_rotvec(change[3:6]).as_matrix()
            state, moved = state + change[6:], moved + change[:6]
            if width == config.last_mm and np.abs(change).max() < config.enough_mm:
                break
        return cost, rotation, centre, state

    def _residuals(
        self, points: np.ndarray, rotation: np.ndarray, centre: np.ndarray, state: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        body = self.body
        offset = (points - centre) @ rotation
        rest = offset + body.center_ct
        back = flowed(body, -state, rest)
        nearest = self._tree.query(back)[1]
        outwards = self._normals[nearest]
        distance = ((back - self._vertices[nearest]) * outwards).sum(1)
        modes = sampled(body, self._modes, flowed(body, -0.5 * state, rest))
        modes = modes.reshape(len(points), 3, -1)
        by_modes = -np.einsum("nd,ndm->nm", outwards, modes)
        return distance, np.concatenate([-outwards, -np.cross(offset, outwards), by_modes], axis=1)
