"""The method `clinic`, read top to bottom: from a cloud of one side to the whole organ.

1. A network makes two hypotheses of where the organ lies and how it is deformed (`network`).
2. Gauss-Newton lays the organ's surface on the points from each of them (`gauss_newton`), with a
   robust kernel; the one that fits best is kept.
3. Where even that fits badly, the undeformed organ is tried in eight turns about the camera's
   axis, in the likeliest hypothesis's place: this repairs most starts that are wrong altogether.

The result is a motion (`motion`): any point of the CT, carried to the camera's frame and back,
with its uncertainty. `locator` reads surfaces, labels and numbers off it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tumortrack.core.process import parallel_for
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import GaussNewton, RegistrationResult
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import PoseHypothesis, RegistrationNetwork
from tumortrack.registration.rest_shape import RestShape

Points = Float[np.ndarray, "n 3"]  # camera frame, mm

_FLIP_MARGIN = 6.0  # logits: beyond this lead the other way round is not tried
_TURNS = 8  # about the camera's axis, where no hypothesis fits

# On 840 clouds of four organs (drags, elastic states, the digital twin's) the eventual winner's
# cost after six steps was at most 2.5 times the least (turned starts: twice). Two thirds of the
# wrong ways round were above three times.
_TRIAL_STEPS = 6
_MAX_COST_RATIO = 3.0  # to the least cost: starts above are given up


@dataclass(frozen=True, eq=False)
class Registration:
    """The organ at rest, laid on clouds (camera frame, mm) that show one side of it."""

    network: RegistrationNetwork
    rest: RestShape
    config: GaussNewtonConfig

    def register(self, points_mm: Points, usual_cost: float = math.inf) -> RegistrationResult:
        """The whole method; the locator calls its two halves, to time each."""
        return self.best_fit(points_mm, self.propose(points_mm), usual_cost)

    @torch.no_grad()
    def propose(self, points_mm: Points) -> list[ElasticMotion]:
        """The network's hypotheses, the likelier first; the second only where it may be right."""
        device = next(self.network.parameters()).device
        cloud = torch.tensor(np.asarray(points_mm, np.float32), device=device)[None]
        with _one_thread() if device.type == "cpu" else nullcontext():
            ways = sorted(
                self.network.flip_hypotheses(cloud), key=lambda way: -float(way.right_way)
            )
        if float(ways[0].right_way - ways[1].right_way) > _FLIP_MARGIN:
            ways = ways[:1]
        return [self._motion(way) for way in ways]

    def best_fit(
        self, points_mm: Points, starts: list[ElasticMotion], usual_cost: float = math.inf
    ) -> RegistrationResult:
        """The best refined start; give the likeliest one first. Above ``usual_cost`` turned starts
        are tried too."""
        fit = self._race(points_mm, starts)
        return self.repaired(points_mm, starts[0], fit) if fit.cost > usual_cost else fit

    def repaired(
        self, points_mm: Points, start: ElasticMotion, fit: RegistrationResult
    ) -> RegistrationResult:
        """The best of a fit and those from the undeformed organ in the start's place, turned all
        around the camera's axis."""
        angles = np.arange(_TURNS) * 360 / _TURNS
        turns = Rotation.from_euler("z", angles[:, None], degrees=True).as_matrix()
        at_rest = self.rest.body.mean
        turned = [
            ElasticMotion(self.rest, turn @ start.rotation, start.centre_mm, at_rest)
            for turn in turns
        ]
        return min(fit, self._race(points_mm, turned), key=lambda fit: fit.cost)

    def _race(self, points_mm: Points, starts: list[ElasticMotion]) -> RegistrationResult:
        """All starts go a few steps; those that may still win go on."""
        runners = [GaussNewton(self.rest, points_mm, start, self.config) for start in starts]
        for steps in (min(_TRIAL_STEPS, self.config.steps), self.config.steps):
            least = min(runner.cost for runner in runners)
            runners = [runner for runner in runners if runner.cost <= _MAX_COST_RATIO * least]
            _run_all(runners, steps)
        return min(runners, key=lambda runner: runner.cost).result()

    def _motion(self, way: PoseHypothesis) -> ElasticMotion:
        parts = (way.rotation, way.centre_mm, way.coefficients)
        rotation, centre, coefficients = (part[0].double().cpu().numpy() for part in parts)
        return ElasticMotion(self.rest, rotation, centre, coefficients)


def _run_all(runners: list[GaussNewton], steps: int) -> None:
    def run(part: slice) -> None:
        for runner in runners[part]:
            runner.run(steps)

    parallel_for(run, len(runners), 1)


@contextmanager
def _one_thread() -> Iterator[None]:
    """One thread for a network so small that a second saves nothing: it would wait busily for more
    work, milliseconds long, on the core where the refinement is to run.

    The number is the whole process's: nothing else should start to use torch meanwhile.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
