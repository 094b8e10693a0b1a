"""Training a registration network: it learns correspondences; the refined motion is validated."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from tumortrack.core.errors import InputError
from tumortrack.models.config import RegistrationHeadConfig
from tumortrack.models.in_distribution import fit_mm, spread_mm
from tumortrack.registration.canonical_frame import carry_over, upright_of
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.model import RegistrationModel, UncertaintyCalibration
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import shape_of
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import FixedPoints
from tumortrack.simulate.targets import draw_targets
from tumortrack.training.run import TrainingRun
from tumortrack.training.task import TrainingTask, mean_iou_of

_USUAL = 90  # per cent of the validation scenes have no more than the usual cost
_COVERED = 0.683  # of all errors lie within this radius if each axis errs normally by 1
_RADIUS = 1.878
_AT_SURFACE = 0.5  # of the points whose positions are learnt; the others lie inside the parts


class RegistrationTask(TrainingTask):
    """Where fixed points of the organ go in each scene."""

    points: FixedPoints
    body: ElasticBody

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        super().__init__(run, device)
        if self.body is None:
            raise InputError(
                "a registration network learns from elastic deformations; the scene configuration "
                "has none."
            )
        self._shape = shape_of(run.anatomy_ct, self.body)
        self.points = _points(run)
        self._last: tuple[bytes, list[tuple[ElasticMotion, RegistrationResult]]] | None = None

    def initialize(self, network: RegistrationNetwork) -> None:
        run, shape = self._run, self._shape
        network.initialize(shape, run.up_lps, self.points.points_ct)
        if run.start is not None:
            where = shape.body.center_ct, shape.long_axis
            upright = upright_of(run.anatomy_ct.organ, run.up_lps, *where)
            carry_over(network, run.start.weights, upright)

    def miou(self, network: RegistrationNetwork) -> float:
        scenes, guesses = self._scenes, []
        for (_, fit), points_mm in zip(self._fits(network), scenes.points_mm, strict=True):
            rest = fit.motion.back(points_mm).astype(np.float32)
            guesses.append(self._shape.labels_at(rest)[0])
        return mean_iou_of(np.stack(guesses), scenes.labels, len(self._run.anatomy_ct.parts) + 1)

    def model(self, network: RegistrationNetwork, provenance: dict[str, Any]) -> RegistrationModel:
        scenes, drafts = self._scenes, self._fits(network)
        usual_cost = float(np.percentile([fit.cost for _, fit in drafts], _USUAL))
        repaired = self._registration(network).repaired
        fits = [  # as the model will make them, knowing the usual cost
            repaired(cloud, start, fit) if fit.cost > usual_cost else fit
            for cloud, (start, fit) in zip(scenes.clouds_mm, drafts, strict=True)
        ]
        errors, ratios = [], []
        for fit, points_mm, points_ct, labels in zip(
            fits, scenes.points_mm, scenes.points_ct, scenes.labels, strict=True
        ):
            inside_ct, inside_mm = points_ct[labels > 0], points_mm[labels > 0]
            deviation = fit.motion.std_mm(inside_ct)
            assert deviation is not None
            error = np.linalg.norm(fit.motion.carry(inside_ct) - inside_mm, axis=1)
            errors.append(error.mean())
            ratios.append(error / deviation)
        std_scale = float(np.quantile(np.concatenate(ratios), _COVERED)) / _RADIUS
        about = {**provenance, "validation_tre_mm": round(float(np.median(errors)), 3)}
        spreads = [spread_mm(cloud) for cloud in scenes.clouds_mm]
        off = [fit_mm(np.abs(fit.distances_mm)) for fit in fits]
        return RegistrationModel(
            **self._fields(network, about, spreads, off),
            shape=self._shape,
            calibration=UncertaintyCalibration(std_scale=std_scale, usual_cost=usual_cost),
        )

    def _fits(self, network: RegistrationNetwork) -> list[tuple[ElasticMotion, RegistrationResult]]:
        """The likeliest start and the best fit in each validation scene; kept for the same weights,
        since the last ones are mostly the best."""
        weights = b"".join(w.numpy(force=True).tobytes() for w in network.state_dict().values())
        if self._last is None or self._last[0] != weights:
            network.eval()
            registration, fits = self._registration(network), []
            for cloud in self._scenes.clouds_mm:
                starts = registration.propose(cloud)
                fits.append((starts[0], registration.best_fit(cloud, starts)))
            self._last = weights, fits
        return self._last[1]

    def _registration(self, network: RegistrationNetwork) -> Registration:
        return Registration(network, self._shape, self._run.config.refine)


def _points(run: TrainingRun) -> FixedPoints:
    """Points of the organ's surface, evenly drawn vertices, and of the parts' insides."""
    decoder = run.config.network.decoder
    assert isinstance(decoder, RegistrationHeadConfig)
    count = decoder.points
    rng = np.random.default_rng([run.seed, 0x9A49])
    vertices = run.anatomy_ct.organ.vertices_mm
    surface = vertices[rng.choice(len(vertices), round(count * _AT_SURFACE), replace=True)]
    inner = draw_targets(run.anatomy_ct, run.seed).points_ct
    inner = inner[rng.choice(len(inner), count - len(surface), replace=True)]
    points = np.concatenate([surface, inner]).astype(np.float32)
    return FixedPoints(points, np.zeros(len(points), np.uint8))
