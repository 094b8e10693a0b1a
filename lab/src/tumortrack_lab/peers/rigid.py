"""Rigid registration as a peer: the best pose of the search wins."""

from __future__ import annotations

from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Fit, rigid_carry, stopwatch
from tumortrack_lab.peers.pose_search import PoseSearch, RigidConfig


class Rigid:
    """The best rigid pose as a peer."""

    def __init__(
        self, anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: RigidConfig
    ) -> None:
        self.name = "rigid" if config.orientation == "facing" else "rigid_any_rotation"
        with stopwatch() as watch:
            self._search = PoseSearch(anatomy_ct, up_lps, config)
        self.prepare_s = watch.seconds

    def fit(self, scene: Scene) -> Fit:
        """The pose of least error.

        Raises:
            NoEstimate: fewer than 20 points.
        """
        with stopwatch() as watch:
            best = self._search.poses(scene.cloud)[0]
        report = {"start": best.start, "residual_mm": best.error_mm}
        return Fit(rigid_carry(best.camera_from_ct), watch.seconds, report)
