"""Errors of the model that neighbours share: segmentation, and what the elastic body is not.

Noise belongs to single points. The surface that they are compared with errs too: by a field over
the organ's surface, correlated over centimetres, which points, touches and outlines share. It is
marginalised: of a smooth misfit so much may be the model's. Source: model discrepancy as a
Gaussian process, Kennedy and O'Hagan 2001 (doi 10.1111/1467-9868.00294).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from tumortrack.core.geometry import triangles_of
from tumortrack.core.mesh_kernels import farthest
from tumortrack.core.types import Mesh

# Two readers' kidneys differ by 0.5 mm rms, correlated over centimetres (KiTS23).
STD_MM, LENGTH_MM = 0.5, 20.0
_APART = 0.85  # lengths between neighbouring nodes, at most
_MOST_NODES = 256  # of a large organ: they then lie farther apart
_RIDGE = 1e-3  # of the variance: keeps the correlations invertible


@dataclass(frozen=True, eq=False)
class ModelError:
    """The field's nodes on an organ's surface (CT, mm), and the precision of their values."""

    nodes_ct: Float64[np.ndarray, "k 3"]
    precision: Float64[np.ndarray, "k k"]

    @classmethod
    def of(cls, organ: Mesh) -> ModelError:
        """Of an organ in the CT."""
        area_mm2 = np.linalg.norm(triangles_of(organ.vertices_mm, organ.faces)[1], axis=1).sum() / 2
        count = int(area_mm2 / (_APART * LENGTH_MM) ** 2) + 1
        vertices = organ.vertices_mm
        chosen = np.empty((1, min(count, _MOST_NODES, len(vertices))), np.int64)
        farthest(np.ascontiguousarray(vertices.T[None], np.float32), np.zeros(1, np.int64), chosen)
        nodes_ct = vertices[chosen[0]]
        ridge = _RIDGE * STD_MM**2 * np.eye(len(nodes_ct))
        return cls(nodes_ct, np.linalg.inv(covariance_mm2(nodes_ct) + ridge))

    def nearest(self, points_ct: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """The number of the node that each point has its error of."""
        nodes = self.nodes_ct
        return ((nodes**2).sum(1) / 2 - points_ct @ nodes.T).argmin(1)

    def equations(
        self,
        node: Int64[np.ndarray, " n"],
        rows: Float[np.ndarray, "n q"],
        weights: Float64[np.ndarray, " n"],
        scale: float = 1.0,
    ) -> tuple[Float64[np.ndarray, "k k"], Float64[np.ndarray, "k q"]]:
        """Of the field, if it is so many times as large, in a Gauss-Newton step: its own curvature,
        and that with ``rows``, each of the node that errs with it."""
        count = len(self.nodes_ct)
        order = np.argsort(node, kind="stable")
        used, first = np.unique(node[order], return_index=True)
        across = np.zeros((count, rows.shape[1]))
        across[used] = np.add.reduceat((rows * weights[:, None])[order], first)
        own = self.precision / scale**2 + np.diag(np.bincount(node, weights, count))
        return own, across


def covariance_mm2(points_ct: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n n"]:
    """Of the field at points on the surface."""
    squares = ((points_ct[:, None] - points_ct[None]) ** 2).sum(2)
    return STD_MM**2 * np.exp(-squares / (2 * LENGTH_MM**2))
