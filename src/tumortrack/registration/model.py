"""A model that registers an elastic body: the organ at rest, and how far to trust its figures.

Nothing is learnt. On simulated scenes, whose truth is known, it is measured what a right fit costs,
by which factor its standard deviations are off, and how far its points spread.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from safetensors.numpy import load, save

from tumortrack.core.cloud import thin_cloud
from tumortrack.core.config import Config, check_seed, from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import FAR_MM
from tumortrack.core.evidence import Cut
from tumortrack.core.process import parallel_map
from tumortrack.core.types import Anatomy, DepthError
from tumortrack.io.model_folder import SHAPE, organ_of, read_tensors
from tumortrack.io.scene_folder import draw_targets
from tumortrack.organ.body import BodyConfig
from tumortrack.organ.rest_shape import RestShape, distances_of
from tumortrack.registration.base_model import Model
from tumortrack.registration.config import RegistrationConfig
from tumortrack.registration.flap import cut_shape
from tumortrack.registration.gauss_newton import RegistrationResult, refine
from tumortrack.registration.in_distribution import InDistributionRange, fit_mm, spread_mm
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.registration import Registration
from tumortrack.registration.search import PosePrior
from tumortrack.simulation.deform import links_of
from tumortrack.simulation.scene import PoseConfig, SceneRecipe, Simulator, body_for

_USUAL = 90  # per cent of the right fits cost no more than the usual cost
# This share of all errors lies within this radius if each axis errs normally by 1; the others may
# come from fits that are wrong altogether.
_COVERED, _RADIUS = 0.9, 2.5


class UncertaintyCalibration(Config, frozen=True):
    """By scenes whose truth is known: standard deviations are multiplied by ``std_scale``, and nine
    tenths of the right fits cost no more than ``usual_cost``."""

    std_scale: float
    usual_cost: float

    def __post_init__(self) -> None:
        self.check_between("calibration", std_scale=(0.05, 50), usual_cost=(1e-3, 1e6))


@dataclass(frozen=True, eq=False, kw_only=True)
class RegistrationModel(Model):
    """See ``Model``; ``shape`` is the organ of the CT with its elastic body."""

    config: RegistrationConfig
    shape: RestShape
    calibration: UncertaintyCalibration

    @cached_property
    def registration(self) -> Registration:
        """The method, with this model's organ and how it may lie."""
        up_lps = self.provenance["up_lps"]
        return Registration(
            self.shape, self.config.refine, pose_prior(self.config.scene.pose, up_lps)
        )

    def with_cut(self, cuts: Sequence[Cut]) -> RegistrationModel:
        """Of the organ with all that was cut of it. Raises as ``flap.cut_shape``."""
        links = (link for each in self.config.scene.deform for link in links_of(each))
        bodies = (getattr(link, "body", None) for link in links)
        poisson = next(body.poisson for body in bodies if isinstance(body, BodyConfig))
        return replace(self, shape=cut_shape(self.shape, cuts, poisson))

    def files(self) -> dict[str, bytes]:
        return {SHAPE: save(self.shape.to_arrays())}

    def entries(self) -> dict[str, Any]:
        return {"calibration": to_builtins(self.calibration)}

    def synchronise(self) -> None:
        """Nothing runs beside."""

    @classmethod
    def from_folder(cls, folder: Path, manifest: dict[str, Any], **known: Any) -> RegistrationModel:
        config = from_builtins(manifest["config"], RegistrationConfig, f"{folder}: config")
        kind = organ_of(manifest, folder)
        shape = RestShape.from_arrays(read_tensors(folder / SHAPE, load), len(known["parts"]), kind)
        calibration = from_builtins(
            manifest["calibration"], UncertaintyCalibration, f"{folder}: calibration"
        )
        up_lps = np.array(known["provenance"]["up_lps"], float)
        if up_lps.shape != (3,) or not np.isclose(np.linalg.norm(up_lps), 1, atol=1e-3):
            raise InputError(f"up_lps {up_lps.tolist()} is no direction.")
        return cls(config=config, shape=shape, calibration=calibration, **known)


def pose_prior(pose: PoseConfig, up_lps: Sequence[float]) -> PosePrior:
    """How an organ may lie, by the poses that scenes show."""
    tilt_degrees = 180.0 if pose.rotations == "full" else pose.tilt_deg
    return PosePrior(np.array(up_lps, float), tilt_degrees)


@dataclass(frozen=True, eq=False)
class _Scene:
    """What a camera sees of a known state (camera frame, mm), the true places of inner points, and
    the undeformed organ in the true pose."""

    views: MultiViewCloud
    inner_mm: Float64[np.ndarray, "m 3"]
    place: ElasticMotion

    def off_mm(self, motion: ElasticMotion, inner_ct: Float64[np.ndarray, "m 3"]) -> float:
        """The mean error of a motion at the inner points."""
        return float(np.linalg.norm(motion.forward(inner_ct) - self.inner_mm, axis=1).mean())


def build_model(
    anatomy_ct: Anatomy,
    up_lps: tuple[float, float, float],
    config: RegistrationConfig,
    seed: int = 0,
    about: dict[str, Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> RegistrationModel:
    """A model of this organ, in seconds; the same arguments give the same model on one machine.

    Args:
        about: more of its provenance.
        progress: called with how many steps are done, and of how many.

    Raises:
        InputError: deformations that are not elastic, numbers that make no body, or a seed that is
            not allowed.
    """
    check_seed(seed)
    steps = 2 + config.scenes + config.searched
    with ThreadPoolExecutor(1) as pool:  # the body takes as long
        distances = pool.submit(distances_of, anatomy_ct)
        body = body_for(anatomy_ct, up_lps, config.scene, seed)
        if body is None:
            raise InputError(
                "the scene configuration has no elastic deformation, which this method needs."
            )
        progress(1, steps)
        rest = RestShape(anatomy_ct, body, distances.result())
    progress(2, steps)
    inner_ct = draw_targets(anatomy_ct, seed).points_ct
    simulator, scenes = Simulator(anatomy_ct, up_lps, config.scene, body), []
    for index in range(config.scenes):
        recipe = SceneRecipe(seed, "validation", index)
        stage = simulator.render(recipe)
        cloud = thin_cloud(stage.cloud, config.scene.cloud.n_points, recipe.generator(999))
        turn, shift_mm = stage.camera_from_ct[:3, :3], stage.camera_from_ct[:3, 3]
        place = ElasticMotion(rest, turn.copy(), turn @ body.center_ct + shift_mm, body.mean)
        inner_mm = stage.forward(inner_ct).astype(float)
        scenes.append(_Scene(MultiViewCloud.from_points([cloud.points_mm]), inner_mm, place))
        progress(3 + index, steps)
    nearby = parallel_map(
        lambda scene: refine(rest, scene.views, scene.place, config.refine), scenes
    )
    pairs = list(zip(scenes, nearby, strict=True))
    right = [fit.cost for scene, fit in pairs if scene.off_mm(fit.motion, inner_ct) <= FAR_MM]
    usual_cost = float(np.percentile(right or [fit.cost for fit in nearby], _USUAL))
    registration = Registration(rest, config.refine, pose_prior(config.scene.pose, up_lps))
    done = count(3 + config.scenes)

    def located(scene: _Scene) -> RegistrationResult:
        fit = registration.register(scene.views)
        progress(next(done), steps)
        return fit

    # A scene a thread: the parts of a search wait for each other.
    fits = parallel_map(located, scenes[: config.searched])
    depth_error = config.scene.calibration.depth_error
    std_scale, errors = _compared_with_truth(registration, scenes, fits, depth_error, inner_ct)
    spreads = [spread_mm(scene.views.points_mm) for scene in scenes]
    fits_mm = [fit_mm(np.abs(fit.distances_mm)) for fit in fits]
    return RegistrationModel(
        config=config,
        parts=anatomy_ct.names,
        in_distribution=InDistributionRange(
            spread_mm=(min(spreads), max(spreads)), fit_mm=float(np.percentile(fits_mm, 95))
        ),
        provenance={"seed": seed, "up_lps": list(up_lps), **(about or {}), **errors},
        shape=rest,
        calibration=UncertaintyCalibration(std_scale=std_scale, usual_cost=usual_cost),
    )


def _compared_with_truth(
    registration: Registration,
    scenes: list[_Scene],
    fits: list[RegistrationResult],
    depth_error: DepthError,
    inner_ct: Float64[np.ndarray, "m 3"],
) -> tuple[float, dict[str, float]]:
    """The factor for standard deviations, 1 or more, and how far off the answers were."""
    errors, nearest, ratios = [], [], []
    for scene, fit in zip(scenes, fits, strict=False):
        refined = registration.refine_compliance(fit)
        share = depth_error.share(refined.motion.centre_mm[2])
        covariance_mm2 = replace(refined.motion, depth_share=share).covariance_mm2(inner_ct)
        assert covariance_mm2 is not None
        away = refined.motion.forward(inner_ct) - scene.inner_mm
        errors.append(scene.off_mm(refined.motion, inner_ct))
        others = [scene.off_mm(alternative.motion, inner_ct) for alternative in fit.alternatives]
        nearest.append(min([errors[-1], *others]))
        solved = np.linalg.solve(covariance_mm2, away[..., None])[..., 0]
        ratios.append(np.sqrt((solved * away).sum(1)))
    # Not below 1: these organs are states of the library that the fit knows, and real ones are not.
    std_scale = max(1.0, float(np.quantile(np.concatenate(ratios), _COVERED)) / _RADIUS)
    far = float(np.mean(np.array(nearest) > FAR_MM))  # no alternative is right
    return std_scale, {
        "validation_tre_mm": round(float(np.median(errors)), 3),
        "validation_far": far,
    }
