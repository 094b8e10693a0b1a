"""What each method learns, how it is validated, and the model it leaves: a class per method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import FAR_MM
from tumortrack.core.process import parallel_map
from tumortrack.imaging.symmetry import alike, half_turns
from tumortrack.models.config import RegistrationHeadConfig
from tumortrack.models.in_distribution import InDistributionRange, fit_mm, spread_mm
from tumortrack.models.model import Model
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import Latent, OccupancyNetwork
from tumortrack.occupancy.volume import FIT_STEPS, lattice_over, surface_distances
from tumortrack.registration.canonical_frame import carry_over, upright_of
from tumortrack.registration.gauss_newton import RegistrationResult, posterior
from tumortrack.registration.looks import Looks
from tumortrack.registration.model import RegistrationModel, UncertaintyCalibration
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import distances_of, shape_of
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import FixedPoints, OccupancyPool, PartPool, organ_pool
from tumortrack.simulate.scene import SceneRecipe, Simulator, body_for, refill
from tumortrack.simulate.scene_folder import draw_targets
from tumortrack.training.state import TrainingRun

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory
_USUAL = 90  # per cent of the validation scenes have no more than the usual cost
# Of all errors lie within this radius if each axis errs normally by 1; the others, a tenth, may
# come from fits that are wrong altogether.
_COVERED, _RADIUS = 0.9, 2.5
_AT_SURFACE = 0.5  # of the points whose positions are learnt; the others lie inside the parts


def task_of(run: TrainingRun, device: torch.device) -> TrainingTask:
    """The task of a run's method; a part too small to be learnt, or deformations that do not fit
    the network, raise InputError."""
    if isinstance(run.config.network.decoder, RegistrationHeadConfig):
        return RegistrationTask(run, device)
    return OccupancyTask(run, device)


class TrainingTask(ABC):
    """What a method learns, how it is validated, and the model it leaves; a class per method."""

    points: FixedPoints | OccupancyPool  # of the training scenes
    body: ElasticBody | None  # the organ's, where scenes or model need it

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run, self._device = run, device
        self.body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)

    @abstractmethod
    def initialize(self, network: Any) -> None:
        """Give a fresh network what does not have to be learnt."""

    @abstractmethod
    def miou(self, network: Any) -> float:
        """On the validation scenes."""

    def tre_mm(self, network: Any) -> float | None:
        """There: median over the scenes of the mean error of points inside; None without a
        motion."""
        return None

    @abstractmethod
    def model(self, network: Any, provenance: dict[str, Any]) -> Model:
        """The finished model of the network."""

    @abstractmethod
    def _pool(self) -> PartPool:
        """Points about the organ, to validate on."""

    @cached_property
    def _scenes(self) -> ValidationScenes:
        """The first scenes of the ``validation`` stream."""
        run, config, pool, rows = self._run, self._run.config, self._pool(), []
        simulator = Simulator(run.anatomy_ct, run.up_lps, config.scene, self.body)
        for index in range(config.validation_pairs):
            recipe = SceneRecipe(run.seed, "validation", index)
            scene = simulator.render(recipe)
            drawn, answer = pool.draw_evenly(recipe.generator(999), config.validation_points)
            observed = scene.cloud.points_mm
            organ = scene.carry(run.anatomy_ct.organ.vertices_mm) - np.median(observed, axis=0)
            box = np.array([organ.min(0), organ.max(0)], float)
            cloud = refill(observed, config.scene.cloud.n_points)
            rows.append((cloud, drawn, scene.carry(drawn), answer, box))
        return ValidationScenes(*(np.stack(column) for column in zip(*rows, strict=True)))

    def _mean_iou(self, guess: UInt8[np.ndarray, "s q"]) -> float:
        """Mean over the parts (organ, tumors; not the outside) of the IoU of labels over all points
        of the validation scenes."""
        n_classes = len(self._run.anatomy_ct.parts) + 1
        pairs = guess.astype(np.int64).ravel() * n_classes + self._scenes.labels.ravel()
        table = np.bincount(pairs, minlength=n_classes**2).reshape(n_classes, n_classes)
        both = table.diagonal()
        either = table.sum(0) + table.sum(1) - both
        return float((both / np.maximum(either, 1))[1:].mean())

    def _fields(
        self, network: Any, provenance: dict[str, Any], clouds_mm: Sequence[tuple[float, float]]
    ) -> dict[str, Any]:
        """What models of both methods hold. ``clouds_mm``: of validation scenes, how far the points
        spread, and how far they lie from the surface that was found."""
        spreads, fits = zip(*clouds_mm, strict=True)
        spread_mm, fit_mm = (min(spreads), max(spreads)), float(np.percentile(fits, 95))
        return {
            "network": network,
            "config": self._run.config,
            "parts": self._run.anatomy_ct.names,
            "query_box_mm": grown_box(self._scenes.boxes_mm),
            "in_distribution": InDistributionRange(spread_mm=spread_mm, fit_mm=fit_mm),
            "provenance": provenance,
        }


class OccupancyTask(TrainingTask):
    """Labels of points near surfaces, as in the paper."""

    points: OccupancyPool

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self.points = OccupancyPool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        super().__init__(run, device)

    def _pool(self) -> PartPool:
        return self.points.parts[0]

    def initialize(self, network: OccupancyNetwork) -> None:
        """An occupancy network knows nothing at first."""

    @torch.no_grad()
    def miou(self, network: OccupancyNetwork) -> float:
        network.eval()
        arrays = self._scenes.clouds_mm, self._scenes.points_mm
        batches = (torch.from_numpy(v).to(self._device).split(_AT_ONCE) for v in arrays)
        guess = torch.cat([network(*pair).argmax(-1) for pair in zip(*batches, strict=True)])
        return self._mean_iou(guess.to(torch.uint8).cpu().numpy())

    @torch.no_grad()
    def model(self, network: OccupancyNetwork, provenance: dict[str, Any]) -> OccupancyModel:
        network.eval()
        scenes, ranges = self._scenes, []
        for points_mm, box_mm in zip(scenes.clouds_mm[:_FIT_ON], scenes.boxes_mm, strict=False):
            latent = network.encode(torch.from_numpy(points_mm).to(self._device)[None])
            around = grown_box(box_mm[None] + np.median(points_mm, axis=0))
            fit = spread = spread_mm(points_mm)
            with suppress(NoEstimate):  # after a few steps a network finds no organ
                lattice = lattice_over(partial(self._logits, network, latent), around, FIT_STEPS)
                fit = fit_mm(surface_distances(lattice, points_mm))
            ranges.append((spread, fit))
        if same := alike(half_turns(self._run.anatomy_ct)):
            provenance = {**provenance, "half_turn_mm": same[0].mean_mm}
        return OccupancyModel(**self._fields(network, provenance, ranges))

    def _logits(
        self, network: OccupancyNetwork, latent: Latent, queries_mm: np.ndarray
    ) -> torch.Tensor:
        parts = torch.from_numpy(queries_mm).to(self._device)[None].split(_QUERIES, dim=1)
        return torch.cat([network.query(latent, part)[0] for part in parts])


class RegistrationTask(TrainingTask):
    """Where fixed points of the organ go in each scene."""

    points: FixedPoints
    body: ElasticBody

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        about = run.anatomy_ct, run.config.scene.occupancy, run.seed
        with ThreadPoolExecutor(1) as beside:  # the body takes as long, and needs neither
            distances = beside.submit(distances_of, run.anatomy_ct)
            self._labelled = beside.submit(organ_pool, *about)
            super().__init__(run, device)
        if self.body is None:
            raise InputError(
                "a registration network learns from elastic deformations; the scene configuration "
                "has none."
            )
        self._shape = shape_of(run.anatomy_ct, self.body, distances.result())
        self.points = _learnt_points(run)
        self._last: tuple[bytes, list[tuple[ElasticMotion, RegistrationResult]]] | None = None

    def _pool(self) -> PartPool:
        return self._labelled.result()

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
        return self._mean_iou(np.stack(guesses))

    def tre_mm(self, network: RegistrationNetwork) -> float:
        fits = self._fits(network)
        return float(
            np.median([_mean_mm(self._away_mm(n, fit)) for n, (_, fit) in enumerate(fits)])
        )

    def model(self, network: RegistrationNetwork, provenance: dict[str, Any]) -> RegistrationModel:
        scenes, drafts = self._scenes, self._fits(network)
        # What is usual of fits that are right: a network that has learnt little proposes many that
        # are not, whose costs would pass for usual.
        right = [
            fit.cost
            for n, (_, fit) in enumerate(drafts)
            if _mean_mm(self._away_mm(n, fit)) <= FAR_MM
        ]
        usual_cost = float(np.percentile(right or [fit.cost for _, fit in drafts], _USUAL))
        more = self._registration(network).look_around
        fits = [  # as the model will make them, knowing the usual cost
            more(cloud, likeliest, fit) if fit.cost > usual_cost else fit
            for cloud, (likeliest, fit) in zip(scenes.clouds_mm, drafts, strict=True)
        ]
        errors, nearest, ratios = [], [], []
        for n, (cloud, fit) in enumerate(zip(scenes.clouds_mm, fits, strict=True)):
            motion = replace(
                posterior(fit.motion, Looks.of([cloud]), self._run.config.refine),
                calibration=self._run.config.scene.calibration,
            )
            known_mm2 = motion.covariance_mm2(scenes.points_ct[n, scenes.labels[n] > 0])
            assert known_mm2 is not None
            away = self._away_mm(n, fit)
            others = [self._away_mm(n, rival) for rival in fit.rivals]
            errors.append(_mean_mm(away))
            nearest.append(min(map(_mean_mm, (away, *others))))
            solved = np.linalg.solve(known_mm2, away[..., None])[..., 0]
            ratios.append(np.sqrt((solved * away).sum(1)))
        std_scale = float(np.quantile(np.concatenate(ratios), _COVERED)) / _RADIUS
        about = {
            **provenance,
            "validation_tre_mm": round(float(np.median(errors)), 3),
            "validation_far": float(np.mean(np.array(nearest) > FAR_MM)),  # no rival is right
        }
        pairs = zip(scenes.clouds_mm, fits, strict=True)
        ranges = [(spread_mm(cloud), fit_mm(np.abs(fit.distances_mm))) for cloud, fit in pairs]
        return RegistrationModel(
            **self._fields(network, about, ranges),
            shape=self._shape,
            calibration=UncertaintyCalibration(std_scale=std_scale, usual_cost=usual_cost),
        )

    def _fits(self, network: RegistrationNetwork) -> list[tuple[ElasticMotion, RegistrationResult]]:
        """The likeliest hypothesis and the best fit in each validation scene; kept for the same
        weights, since the last ones are mostly the best."""
        weights = b"".join(w.numpy(force=True).tobytes() for w in network.state_dict().values())
        if self._last is None or self._last[0] != weights:
            network.eval()
            registration, clouds = self._registration(network), self._scenes.clouds_mm
            proposed = [(cloud, registration.propose(cloud)) for cloud in clouds]
            fits = parallel_map(lambda one: registration.best_fit(*one), proposed)
            likeliest = (hypotheses[0] for _, hypotheses in proposed)
            self._last = weights, list(zip(likeliest, fits, strict=True))
        return self._last[1]

    def _away_mm(self, scene: int, fit: RegistrationResult) -> Float64[np.ndarray, "n 3"]:
        """From where the points inside are in a validation scene to where its fit has them."""
        scenes, inside = self._scenes, self._scenes.labels[scene] > 0
        found_mm = fit.motion.carry(scenes.points_ct[scene, inside])
        return found_mm - scenes.points_mm[scene, inside]

    def _registration(self, network: RegistrationNetwork) -> Registration:
        return Registration(network, self._shape, self._run.config.refine)


def _mean_mm(offsets_mm: Float64[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(offsets_mm, axis=1).mean())


def _learnt_points(run: TrainingRun) -> FixedPoints:
    """Points of the organ's surface, evenly drawn vertices, and of the parts' insides."""
    decoder = run.config.network.decoder
    assert isinstance(decoder, RegistrationHeadConfig)
    count = decoder.points
    rng = np.random.default_rng([run.seed, 0x9A49])
    vertices = run.anatomy_ct.organ.vertices_mm
    surface = vertices[rng.choice(len(vertices), round(count * _AT_SURFACE), replace=True)]
    inner = draw_targets(run.anatomy_ct, run.seed).points_ct
    inner = inner[rng.choice(len(inner), count - len(surface), replace=True)]
    return FixedPoints(np.concatenate([surface, inner]).astype(np.float32))


@dataclass(frozen=True, eq=False)
class ValidationScenes:
    """Scenes of the ``validation`` stream with points spread evenly over the organ's enlarged
    box, so that numbers of points are volumes; camera frame, mm."""

    clouds_mm: Float32[np.ndarray, "s n 3"]
    points_ct: Float32[np.ndarray, "s q 3"]
    points_mm: Float32[np.ndarray, "s q 3"]
    labels: UInt8[np.ndarray, "s q"]
    boxes_mm: Float64[np.ndarray, "s 2 3"]  # the organ's, relative to the points' median


def grown_box(boxes_mm: Float64[np.ndarray, "s 2 3"]) -> Float64[np.ndarray, "2 3"]:
    """The box of all the boxes, 10 % larger."""
    lower, upper = boxes_mm[:, 0].min(0), boxes_mm[:, 1].max(0)
    return np.stack([lower - 0.05 * (upper - lower), upper + 0.05 * (upper - lower)])
