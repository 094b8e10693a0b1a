"""What chance decides in a batch of scenes before their pictures are taken, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int64

from tumortrack.sense.noise import CALIBRATED, CLEAN
from tumortrack.simulate.deform import ChainConfig, DeformConfig, DragConfig, RestConfig
from tumortrack.simulate.deform.base import Deformation
from tumortrack.simulate.deform.chain import Chain
from tumortrack.simulate.deform.drag import Drags
from tumortrack.simulate.deform.stretch import Stretch, StretchConfig
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator, crop_of


def unsupported(config: SceneConfig) -> str | None:
    """Why scenes of this configuration cannot be made in batches; None where they can."""
    lacks = [
        what
        for what, on in (
            ("sensor noise", config.noise != CLEAN),
            ("background", config.clutter.scenes > 0),
            ("occlusion", config.occlusion.scenes > 0 and config.occlusion.largest_share > 0),
            ("cameras out of calibration", config.calibration != CALIBRATED),
            (
                "deformations other than drags, squeezing and bending",
                not all(map(_in_steps, config.deform)),
            ),
        )
        if on
    ]
    return f"{', '.join(lacks)}: made on the CPU alone" if lacks else None


def _in_steps(model: DeformConfig) -> bool:
    """Whether a deformation is some drags and then at most one squeeze and bend."""
    links = model.links if isinstance(model, ChainConfig) else (model,)
    *first, last = links
    return all(isinstance(link, DragConfig) for link in first) and isinstance(
        last, DragConfig | StretchConfig | RestConfig
    )


@dataclass(frozen=True, eq=False)
class BatchPlan:
    """A batch of b scenes, k drags each (shift 0: none); mm. Picklable."""

    recipes: np.ndarray  # of SceneRecipe
    attempts: Int64[np.ndarray, " b"]  # the how-manieth draw of the recipe
    camera_from_ct: Float64[np.ndarray, "b 4 4"]
    centres_ct: Float32[np.ndarray, "b k 3"]
    shifts_mm: Float32[np.ndarray, "b k 3"]
    sigmas_mm: Float32[np.ndarray, "b k"]
    stretches: Float32[np.ndarray, "b s 20"]  # s is 1 where the configuration has any, else 0
    near_mm: Float32[np.ndarray, " b"]  # the cloud's depths
    far_mm: Float32[np.ndarray, " b"]
    n_points: Int64[np.ndarray, " b"]
    states: np.ndarray  # of the generators, for what is drawn after the picture

    def replaced(self, rows: Int64[np.ndarray, " r"], others: BatchPlan) -> BatchPlan:
        """The plan with other scenes in these rows."""
        arrays = {}
        for field in fields(self):
            array = getattr(self, field.name).copy()
            array[rows] = getattr(others, field.name)
            arrays[field.name] = array
        return BatchPlan(**arrays)


def plan_scenes(
    simulator: Simulator, recipes: Sequence[SceneRecipe], attempts: Sequence[int]
) -> BatchPlan:
    """Draw the scenes of these recipes, each at this attempt."""
    config = simulator.config
    n_drags = max(map(_count_drags, config.deform))
    n_stretches = int(any(isinstance(_links(m)[-1], StretchConfig) for m in config.deform))
    rows = []
    for recipe, attempt in zip(recipes, attempts, strict=True):
        rng = recipe.generator(attempt)
        drawn = simulator.draw(rng)
        rng.integers(2**62)  # the seed of a noise that is off
        crop = crop_of(config, drawn.free, rng)
        drags, stretch = _steps(drawn.deformation, n_drags, n_stretches)
        depths = (crop.near_mm, crop.far_mm, crop.n_points)
        rows.append((drawn.camera_from_ct, *drags, stretch, *depths, rng.bit_generator.state))
    cameras, centres, shifts, sigmas, stretches, near, far, n_points, states = zip(
        *rows, strict=True
    )
    return BatchPlan(
        np.array(recipes, object),
        np.array(attempts),
        np.stack(cameras),
        np.stack(centres),
        np.stack(shifts),
        np.stack(sigmas),
        np.stack(stretches),
        np.array(near, np.float32),
        np.array(far, np.float32),
        np.array(n_points),
        np.array(states, object),
    )


def _links(model: DeformConfig) -> tuple[DeformConfig, ...]:
    return model.links if isinstance(model, ChainConfig) else (model,)


def _count_drags(model: DeformConfig) -> int:
    return sum(
        times
        for link in _links(model)
        if isinstance(link, DragConfig)
        for _, _, times in link.steps
    )


def _steps(
    deformation: Deformation, n_drags: int, n_stretches: int
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """A deformation as (centres, shifts, sigmas) of drags and numbers of a stretch."""
    centres, shifts = np.zeros((2, n_drags, 3), np.float32)
    sigmas = np.ones(n_drags, np.float32)
    stretch = np.tile(_NO_STRETCH, (n_stretches, 1))
    done = 0
    for link in deformation.links if isinstance(deformation, Chain) else (deformation,):
        if isinstance(link, Drags):
            here = slice(done, done + len(link.sigmas_mm))
            centres[here], shifts[here] = link.centres_ct, link.shifts_mm
            sigmas[here] = link.sigmas_mm
            done = here.stop
        elif isinstance(link, Stretch):
            stretch[0] = _numbers(link)
    return (centres, shifts, sigmas), stretch


def _numbers(stretch: Stretch) -> Float32[np.ndarray, " 20"]:
    """centre (3), matrix (9), along (3), across (3), sagitta, reach."""
    return np.array(
        [
            *stretch.centre_ct,
            *stretch.matrix.ravel(),
            *stretch.along,
            *stretch.across,
            stretch.sagitta_mm,
            stretch.reach_mm,
        ],
        np.float32,
    )


_NO_STRETCH = _numbers(
    Stretch(np.zeros(3), np.eye(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 0.0, 1.0)
)
