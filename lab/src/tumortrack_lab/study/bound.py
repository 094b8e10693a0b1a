"""What an estimate can reach at best: our elastic body laid on the truth's own correspondences.

No method that anyone could use: the truth says where each known point of the organ is now. With
the visible surface known, what is left is what a surface cannot say of the inside; with all
surfaces known, what is left is what the body's modes cannot represent.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import tumortrack
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.sense.camera import project
from tumortrack.sense.render import Visibility
from tumortrack.simulate.elastic.body import BodyConfig, ElasticBody, build_body
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Fit, kabsch, matched_vertices, stopwatch
from tumortrack_lab.study.methods import Answer, Method, StudyCase, answer_of, code_sha256

BoundName = Literal["visible_bound", "basis_bound"]
BOUNDS: tuple[BoundName, ...] = get_args(BoundName)
_FEWEST = 10  # known points


class BoundConfig(Config, frozen=True):
    """As in ``registration.gauss_newton``: on the phantom 0.3 mm or 2,000 points double the inner
    error."""

    body: BodyConfig = BodyConfig()
    seed: int = 0  # of the body
    sigma_mm: float = 1.0  # of a known point, for modes cannot follow exactly
    n_effective: float = 300.0  # independent points that the known ones are worth
    steps: int = 12


@dataclass(frozen=True, eq=False)
class BoundMotion:
    """An organ's pose and elastic state: x -> rotation (flow(x) - center_ct) + centre_mm."""

    body: ElasticBody
    rotation: Float64[np.ndarray, "3 3"]
    centre_mm: Float64[np.ndarray, " 3"]
    coefficients: Float64[np.ndarray, " m"]

    def carry(self, points_ct: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """CT (LPS, mm) -> camera frame (mm)."""
        offset = self.body.carry(self.coefficients, points_ct).astype(float) - self.body.center_ct
        return offset @ self.rotation.T + self.centre_mm


@dataclass(frozen=True, eq=False)
class Bound(Method):
    """``visible_bound`` knows where every visible vertex of the organ is; ``basis_bound`` where
    every vertex of every part is."""

    name: BoundName
    case: StudyCase
    config: BoundConfig = field(default_factory=BoundConfig)

    @cached_property
    def identity(self) -> dict:
        elastic = Path(tumortrack.__file__).parent / "simulate" / "elastic"
        return {
            "kind": "bound",
            "name": self.name,
            "settings": to_builtins(self.config),
            "code_sha256": code_sha256([Path(__file__), *elastic.glob("*.py")]),
            "tumortrack": tumortrack.__version__,
        }

    @property
    def prepare_s(self) -> float | None:  # type: ignore[override]
        return _body_of(self.case, self.config)[1]

    def locate(self, scene: Scene, grid: int) -> Answer:
        body, rest = _body_of(self.case, self.config)[0], self.case.anatomy_ct
        with stopwatch() as watch:
            known_ct, known_mm = self._known(rest, scene)
            placed = laid_on(body, known_ct, known_mm, self.config)
        left_mm = np.linalg.norm(placed.carry(known_ct) - known_mm, axis=1)
        report = {"start": "truth", "residual_mm": float(np.sqrt(np.mean(left_mm**2)))}
        return answer_of(Fit(placed.carry, watch.seconds, report), rest, scene, grid)

    def _known(self, rest: Anatomy, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        if len(rest.parts) != len(scene.reference.parts):
            raise InputError("the scene has other parts than the case; make its scenes again.")
        pairs = list(zip(rest.parts, scene.reference.parts, strict=True))
        if self.name == "visible_bound":
            now_mm = matched_vertices(*pairs[0])
            seen = seen_vertices(pairs[0][0].moved(now_mm), scene)
            if seen.sum() < _FEWEST:
                raise NoEstimate("hardly any vertex of the organ is in the picture.")
            return pairs[0][0].vertices_mm[seen], now_mm[seen]
        known_mm = [matched_vertices(before, now) for before, now in pairs]
        return np.concatenate([part.vertices_mm for part in rest.parts]), np.concatenate(known_mm)


def seen_vertices(organ_camera: Mesh, scene: Scene) -> Bool[np.ndarray, " v"]:
    """Which vertices the camera sees, but for sensor faults and foreign things."""
    points = organ_camera.vertices_mm
    seen = Visibility(organ_camera)(points, np.zeros(3))
    if scene.depth is not None:
        intrinsics = scene.depth.intrinsics
        pixels, depth = project(points, intrinsics)
        size = np.array([intrinsics.width, intrinsics.height])
        seen &= ((pixels > -0.5) & (pixels < size - 0.5)).all(1) & (depth > 0)
    return seen


def laid_on(
    body: ElasticBody,
    known_ct: Float[np.ndarray, "n 3"],
    known_mm: Float[np.ndarray, "n 3"],
    config: BoundConfig,
) -> BoundMotion:
    """The pose and state that carry known points of the CT to their places most likely. As
    ``registration.gauss_newton``, but points' partners are known: residuals are vectors, and the
    pose needs no prior."""
    modes = len(body.mean)
    pose = kabsch(known_ct, known_mm, np.ones(len(known_ct)))
    rotation = pose[:3, :3]
    centre = rotation @ body.center_ct + pose[:3, 3]
    coefficients = body.mean.copy()
    precision = block_diag(np.zeros((6, 6)), np.linalg.inv(body.covariance))
    weight = min(config.n_effective / len(known_ct), 1.0) / config.sigma_mm**2
    for _ in range(config.steps):
        offset = body.carry(coefficients, known_ct).astype(float) - body.center_ct
        error = (offset - (known_mm - centre) @ rotation).reshape(-1)  # in the CT's axes
        halfway = body.carry(0.5 * coefficients, known_ct)
        shifts = np.broadcast_to(np.eye(3), (len(known_ct), 3, 3))
        turns = np.stack([np.cross(axis, offset) for axis in np.eye(3)], axis=2)
        flat = np.concatenate([shifts, turns, body.modes_at(halfway)], 2).reshape(-1, 6 + modes)
        off = np.concatenate([np.zeros(6), coefficients - body.mean])
        curvature = weight * flat.T @ flat + precision
        change = -np.linalg.solve(curvature, weight * flat.T @ error + precision @ off)
        centre = centre + rotation @ change[:3]
        rotation = rotation @ Rotation.from_rotvec(change[3:6]).as_matrix()
        coefficients = coefficients + change[6:]
    return BoundMotion(body, rotation, centre, coefficients)


@cache
def _body_of(case: StudyCase, config: BoundConfig) -> tuple[ElasticBody, float]:
    """And the seconds that it took; one for both bounds."""
    with stopwatch() as watch:
        body = build_body(case.anatomy_ct, case.up_lps, config.body, config.seed)
    return body, watch.seconds
