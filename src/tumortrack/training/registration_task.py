"""Training a registration network: it learns correspondences; the refined motion is validated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.models.config import RegistrationHeadConfig
from tumortrack.models.in_distribution import InDistributionRange, fit_mm, spread_mm
from tumortrack.registration.canonical_frame import carry_over, upright_of
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.gauss_newton_kernels import KERNEL
from tumortrack.registration.model import RegistrationModel, UncertaintyCalibration
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import shape_of
from tumortrack.simulate.occupancy import FixedPoints, organ_pool
from tumortrack.simulate.scene import Simulator, body_for
from tumortrack.simulate.targets import draw_targets
from tumortrack.training.run import TrainingRun
from tumortrack.training.task import ValidationScenes, mean_iou_of, validation_scenes

_USUAL = 90  # per cent of the validation scenes have no more than the usual cost
_COVERED = 0.683  # of all errors lie within this radius if each axis errs normally by 1
_RADIUS = 1.878
_AT_SURFACE = 0.5  # of the points whose positions are learnt; the others lie inside the parts


class RegistrationTask:
    """Where fixed points of the organ go in each scene."""

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run = run
        body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)
        if body is None:
            raise InputError(
                "a warp network learns from elastic deformations; the scene configuration has none."
            )
        self.body = body
        self._shape = shape_of(run.anatomy_ct, body)
        self.points = _points(run)
        self._last: tuple[bytes, list[tuple[ElasticMotion, RegistrationResult]]] | None = None

    @cached_property
    def _scenes(self) -> ValidationScenes:
        run = self._run
        pool = organ_pool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        simulator = Simulator(run.anatomy_ct, run.up_lps, run.config.scene, self.body)
        return validation_scenes(simulator, pool, run.config, run.seed)

    def initialize(self, network: RegistrationNetwork) -> None:
        run, shape = self._run, self._shape
        network.initialize(shape, run.up_lps, self.points.points_ct)
        if run.start is not None:
            upright = upright_of(
                run.anatomy_ct.organ, run.up_lps, shape.body.center_ct, shape.long_axis
            )
            carry_over(network, run.start.weights, upright)

    def miou(self, network: RegistrationNetwork) -> float:
        return self._summary([fit for _, fit in self._fits(network)]).miou

    def model(self, network: RegistrationNetwork, provenance: dict[str, Any]) -> RegistrationModel:
        fits = self._fits(network)
        usual_cost = float(np.percentile([fit.cost for _, fit in fits], _USUAL))
        summary = self._summary(self._final(network, fits, usual_cost))
        return RegistrationModel(
            network=network,
            config=self._run.config,
            parts=self._run.anatomy_ct.names,
            query_box_mm=self._scenes.query_box_mm,
            in_distribution=summary.in_distribution,
            provenance={**provenance, "validation_tre_mm": round(summary.tre_mm, 3)},
            shape=self._shape,
            calibration=UncertaintyCalibration(
                std_scale=summary.std_scale, usual_cost=usual_cost, kernel=KERNEL
            ),
        )

    def _fits(self, network: RegistrationNetwork) -> list[tuple[ElasticMotion, RegistrationResult]]:
        """The likeliest hypothesis and the best fit in each validation scene; kept for the same
        weights, since the last ones are mostly the best."""
        weights = b"".join(w.numpy(force=True).tobytes() for w in network.state_dict().values())
        if self._last is None or self._last[0] != weights:
            network.eval()
            registration, fits = self._registration(network), []
            for cloud in self._scenes.clouds_mm:
                hypotheses = registration.propose(cloud)
                fits.append((hypotheses[0], registration.best_fit(cloud, hypotheses)))
            self._last = weights, fits
        return self._last[1]

    def _registration(self, network: RegistrationNetwork) -> Registration:
        return Registration(network, self._shape, self._run.config.refine)

    def _final(
        self,
        network: RegistrationNetwork,
        fits: list[tuple[ElasticMotion, RegistrationResult]],
        usual_cost: float,
    ) -> list[RegistrationResult]:
        """The fits as the model will make them, knowing the usual cost."""
        more = self._registration(network).try_turned_starts
        return [
            more(cloud, likeliest, fit) if fit.cost > usual_cost else fit
            for cloud, (likeliest, fit) in zip(self._scenes.clouds_mm, fits, strict=True)
        ]

    def _summary(self, fits: list[RegistrationResult]) -> ValidationSummary:
        """Labels, positions and calibration over all validation scenes."""
        scenes, shape = self._scenes, self._shape
        guesses, errors, deviations = [], [], []
        for fit, points_mm, points_ct, labels in zip(
            fits, scenes.points_mm, scenes.points_ct, scenes.labels, strict=True
        ):
            guesses.append(shape.labels_at(fit.motion.back(points_mm).astype(np.float32))[0])
            inside = labels > 0
            error, deviation = _errors(fit, points_ct[inside], points_mm[inside])
            errors.append(error)
            deviations.append(deviation)
        spreads = [spread_mm(cloud) for cloud in scenes.clouds_mm]
        off = [fit_mm(np.abs(fit.distances_mm)) for fit in fits]
        in_distribution = InDistributionRange(
            spread_mm=(min(spreads), max(spreads)), fit_mm=float(np.percentile(off, 95))
        )
        ratios = np.concatenate(errors) / np.concatenate(deviations)
        return ValidationSummary(
            mean_iou_of(np.stack(guesses), scenes.labels, len(shape.anatomy_ct.parts) + 1),
            float(np.median([part.mean() for part in errors])),
            float(np.quantile(ratios, _COVERED)) / _RADIUS,
            in_distribution,
        )


@dataclass(frozen=True)
class ValidationSummary:
    """IoU of labels, the median scene's target registration error, the factor by which estimated
    standard deviations are to be scaled, and what the clouds are like."""

    miou: float
    tre_mm: float
    std_scale: float
    in_distribution: InDistributionRange


def _errors(
    fit: RegistrationResult,
    points_ct: Float[np.ndarray, "n 3"],
    points_mm: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    deviation = fit.motion.std_mm(points_ct)
    assert deviation is not None
    return np.linalg.norm(fit.motion.carry(points_ct) - points_mm, axis=1), deviation


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
