"""What a research repository would have: the same answers, in the plain way.

The occupancy network as PointNet++ and occupancy networks are usually written: single precision;
farthest points by a Python loop, neighbours by sorting a whole matrix, batch norms apart, the
latent joined to every query, everything in one piece. Of a network it takes single layers and the
configuration and nothing else, so that it is also an independent reference. Source: the forms of
github.com/yanx27/Pointnet_Pointnet2_pytorch and of Mescheder et al., CVPR 2019.

A training pair: NumPy, a ray for each pixel, inside tests. A registration frame by the same method
as ours, with nearest vertices by a tree and SciPy: the placements both ways round, each fitted to
the end, the better one kept, every query tested against the surfaces.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.models.config import MlpDecoderConfig
from tumortrack.models.encoders.pointnet2 import PointNet2Config
from tumortrack.models.normalisation import (
    Aligned,
    CloudBox,
    alignment,
    normalisation,
    turned,
    without_strays,
)
from tumortrack.occupancy.network import Latent, OccupancyNetwork, octave_features
from tumortrack.registration.model import RegistrationModel
from tumortrack.simulate.deform.drag import Drags
from tumortrack.simulate.deform.elastic import ElasticDeformation
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import labels_of
from tumortrack.simulate.scene import RenderedScene

FLOW_STEPS = 12
_Fit = tuple[float, np.ndarray, np.ndarray, np.ndarray]  # cost, rotation, centre, coefficients


class NaiveOccupancy:
    """``encode`` clouds, ``logits`` of queries, in the mode that the network is in."""

    def __init__(self, network: OccupancyNetwork) -> None:
        encoder, decoder = network.config.encoder, network.config.decoder
        assert isinstance(encoder, PointNet2Config)
        assert isinstance(decoder, MlpDecoderConfig)
        self._encoder, self._decoder, self._network = encoder, decoder, network

    def encode(self, points_mm: Tensor) -> Latent:
        """Clouds (B, N, 3), mm."""
        kind = self._network.config.normalisation
        if not isinstance(kind, CloudBox):
            points_mm = without_strays(points_mm, kind.reach * kind.scale_mm)
        centre, scale = normalisation(points_mm, kind)
        points, turn = (points_mm - centre) / scale, None
        if isinstance(kind, Aligned):
            turn = alignment(points)
            points = turned(points, turn)
        return Latent(self._latent(points), centre, scale, turn, ())

    def logits(self, encoded: Latent, queries_mm: Tensor) -> Tensor:
        """Queries (B, Q, 3), mm -> (B, Q, classes), the latent beside each."""
        config, latent = self._decoder, encoded.vector
        given = octave_features(encoded.normalised(queries_mm), config.octaves)
        given = torch.cat([given, latent[:, None].expand(-1, given.shape[1], -1)], -1)
        hidden = given
        for number in range(1, config.hidden_layers + 1):
            if number == config.skip_layer and number > 1:
                hidden = torch.cat([hidden, given], -1)
            hidden = self._layer(f"decoder.layers.{number - 1}", hidden)
        return self._network.decoder.output(hidden)

    def _latent(self, points: Tensor) -> Tensor:
        config = self._encoder
        n = points.shape[1]
        if config.n_points is not None and n > config.n_points:
            points = points[:, torch.arange(config.n_points) * n // config.n_points]
        features = points[..., :0]
        for number, level in enumerate(config.levels):
            k = math.ceil(level.ratio * points.shape[1])
            centres = rows_of(points, farthest_points(points, k))
            near = neighbours(points, centres, level.radius, level.neighbours)
            offsets = (rows_of(points, near) - centres[:, :, None]) / level.radius
            grouped = torch.cat([offsets, rows_of(features, near)], -1)
            grouped = self._layer(f"encoder.levels.{number}.first", grouped)
            for layer in range(len(level.widths) - 1):
                grouped = self._layer(f"encoder.levels.{number}.rest.{layer}", grouped)
            points, features = centres, grouped.max(2).values
        out = torch.cat([points, features], -1)
        for layer in range(len(config.widths)):
            out = self._layer(f"encoder.summary.{layer}", out)
        return out.max(1).values

    def _layer(self, name: str, x: Tensor) -> Tensor:
        """Linear, batch norm where there is one, ReLU."""
        layer: Any = self._network.get_submodule(name)
        return functional.relu(layer.normalise(layer.linear(x)))


def farthest_points(points: Tensor, k: int) -> Tensor:
    """Farthest point sampling of clouds (B, N, 3) -> (B, k), a Python loop; begun at the point
    farthest from the middle."""
    nearest = torch.full(points.shape[:2], torch.inf, device=points.device)
    newest = _square(points - points.mean(1, keepdim=True)).argmax(1)
    chosen = []
    every = torch.arange(len(points), device=points.device)
    for _ in range(k):
        chosen.append(newest)
        nearest = torch.minimum(nearest, _square(points - points[every, newest][:, None]))
        newest = nearest.argmax(1)
    return torch.stack(chosen, 1)


def neighbours(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """The first ``k`` points (B, N, 3) within ``radius`` of each centre (B, M, 3) -> (B, M, k), by
    sorting all; the first of them again where there are fewer."""
    n = points.shape[1]
    index = torch.arange(n, device=points.device).repeat(*centres.shape[:2], 1)
    index[_square(centres[:, :, None] - points[:, None]) > radius**2] = n
    index = index.sort(-1).values[..., :k]
    return torch.where(index == n, index[..., :1].expand_as(index), index).clamp_max(n - 1)


def rows_of(values: Tensor, index: Tensor) -> Tensor:
    """Rows of (B, N, C) at (B, ...) -> (B, ..., C)."""
    every = torch.arange(len(values), device=values.device)
    return values[every.view(-1, *([1] * (index.dim() - 1))), index]


def _square(offsets: Tensor) -> Tensor:
    x, y, z = offsets.unbind(-1)
    return x * x + y * y + z * z


def plain_pair(anatomy_ct: Anatomy, stage: RenderedScene, labels: int) -> np.ndarray:
    """All surfaces deformed, a ray a pixel through a tree that is built anew, and random points
    labelled by inside tests on the deformed surfaces."""
    parts = [part.moved(_carried(stage, part.vertices_mm)) for part in anatomy_ct.parts]
    k = stage.frame.intrinsics
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], -1).reshape(-1, 3)
    mesh = trimesh.Trimesh(parts[0].vertices_mm, parts[0].faces, process=False)
    mesh.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    lower, upper = parts[0].box_mm
    points = np.random.default_rng(0).uniform(lower, upper, (labels, 3)).astype(np.float32)
    return labels_of(Anatomy(tuple(parts)), points)


def _carried(stage: RenderedScene, points_ct: np.ndarray) -> np.ndarray:
    deformation, moved = stage.deformation, points_ct.copy()
    if isinstance(deformation, ElasticDeformation):
        moved = flowed(deformation.body, deformation.coefficients, points_ct)
    else:
        assert isinstance(deformation, Drags)
        drags = zip(
            deformation.centres_ct, deformation.shifts_mm, deformation.sigmas_mm, strict=True
        )
        for centre, shift, sigma in drags:
            square = ((moved - centre) ** 2).sum(1)
            moved += np.exp(-0.5 * square / sigma**2)[:, None] * shift
    return transform_points(stage.camera_from_ct, moved)


def flowed(body: ElasticBody, coefficients: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the CT frame after one unit of time in a body's velocity: midpoint rule,
    SciPy's interpolation."""
    field = np.moveaxis(body.velocity(coefficients), 3, 0)
    moved = np.array(points, float)
    for _ in range(FLOW_STEPS):
        middle = moved + sampled(body, field, moved) / (2 * FLOW_STEPS)
        moved += sampled(body, field, middle) / FLOW_STEPS
    return moved


def sampled(body: ElasticBody, fields: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Fields (f, i, j, k) on a body's lattice at points (n, 3) -> (n, f)."""
    place = (points - body.origin_mm).T / body.spacing_mm
    return np.stack([map_coordinates(f, place, order=1, mode="nearest") for f in fields], 1)


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
        fits = (self._refined(points_mm, *start) for start in starts)
        _, rotation, centre, coefficients = min(fits, key=lambda fit: fit[0])
        moved = (queries_mm - centre) @ rotation + self.body.center_ct
        return self.labels_where(flowed(self.body, -coefficients, moved))

    def labels_where(self, motion_back: np.ndarray) -> np.ndarray:
        """Of places in the CT (n, 3): inside tests on its surfaces."""
        return labels_of(self._anatomy, motion_back.astype(np.float32))

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
