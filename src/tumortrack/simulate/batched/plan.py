"""The random part of a batch of scenes up to their images, drawn on the host, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int64

from tumortrack.simulate.deform import DragConfig, StretchConfig
from tumortrack.simulate.deform.base import Deformation
from tumortrack.simulate.deform.chain import Chain, links_of
from tumortrack.simulate.deform.drag import Drags
from tumortrack.simulate.deform.stretch import Stretch
from tumortrack.simulate.scene import SceneRecipe, Simulator, crop_of

# A stretch as 20 numbers: centre (3), matrix (9), along (3), across (3), sagitta, reach.
_NO_STRETCH = np.array([*[0] * 3, *np.eye(3).ravel(), 1, 0, 0, 0, 1, 0, 0, 1], np.float32)


@dataclass(frozen=True, eq=False)
class BatchPlan:
    """A batch of b scenes, k drags each (shift 0: none); mm. Picklable."""

    recipes: np.ndarray  # of SceneRecipe
    attempts: Int64[np.ndarray, " b"]  # number of the draw of each recipe
    camera_from_ct: Float64[np.ndarray, "b 4 4"]
    centres_ct: Float32[np.ndarray, "b k 3"]
    shifts_mm: Float32[np.ndarray, "b k 3"]
    sigmas_mm: Float32[np.ndarray, "b k"]
    stretches: Float32[np.ndarray, "b s 20"]  # s is 1 where the configuration has any, else 0
    near_mm: Float32[np.ndarray, " b"]  # the cloud's depth range
    far_mm: Float32[np.ndarray, " b"]
    n_points: Int64[np.ndarray, " b"]
    states: np.ndarray  # of the generators, for what is drawn after rendering

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
    models = [links_of(model) for model in config.deform]
    n_drags = max(
        sum(times for link in links if isinstance(link, DragConfig) for _, _, times in link.steps)
        for links in models
    )
    n_stretches = int(any(isinstance(links[-1], StretchConfig) for links in models))
    rows = []
    for recipe, attempt in zip(recipes, attempts, strict=True):
        rng = recipe.generator(attempt)
        drawn = simulator.draw(rng)
        rng.integers(2**62)  # the seed of a noise that is off
        crop = crop_of(config, drawn.free, rng)
        steps = _steps(drawn.deformation, n_drags, n_stretches)
        depths = np.float32(crop.near_mm), np.float32(crop.far_mm), crop.n_points
        rows.append((drawn.camera_from_ct, *steps, *depths, rng.bit_generator.state))
    *columns, states = zip(*rows, strict=True)
    arrays = [np.array(recipes, object), np.array(attempts), *map(np.stack, columns)]
    arrays.append(np.array(states, object))
    return BatchPlan(*arrays)


def _steps(deformation: Deformation, n_drags: int, n_stretches: int) -> tuple[np.ndarray, ...]:
    """A deformation as centres, shifts and sigmas of drags, and numbers of stretches."""
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
            bend = link.along, link.across, [link.sagitta_mm, link.reach_mm]
            stretch[0] = np.concatenate([link.centre_ct, link.matrix.ravel(), *bend])
    return centres, shifts, sigmas, stretch
