"""The electrode's distances of finished motions, slowly: kinematics by pinocchio, closed formulas,
and dense points of surfaces. Nothing of the check that it is compared with is used."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack.core.types import Mesh
from tumortrack_resection.arms.config import ELECTRODE_RADIUS_MM
from tumortrack_resection.motions import LIFT, Motions

Frames = Float64[np.ndarray, "n 4 4"]
_AT_ONCE = 2_000_000  # pairs of points and axes
_COARSE_MM = 2.0


class SlowArms:
    """Tips of both arms by their URDF."""

    def __init__(self, urdf: str) -> None:
        import pinocchio as pin

        self._pin, self._model = pin, pin.buildModelFromXML(urdf)
        self._data = self._model.createData()

    def tips(self, joints_rad: Float64[np.ndarray, "n 12"], arm: str) -> Frames:
        """``table_from_tip``, mm."""
        frame, found = self._model.getFrameId(f"{arm}_tip"), []
        for joints in joints_rad:
            self._pin.framesForwardKinematics(self._model, self._data, joints)
            found.append(self._data.oMf[frame].homogeneous.copy())
        tips = np.array(found)
        tips[:, :3, 3] *= 1000
        return tips


def configurations(arms: SlowArms, motions: Motions, step_mm: float) -> tuple[np.ndarray, int]:
    """All twelve joints (n, 12), so dense that no end of the electrode moves much farther from one
    to the next; and the number of the first of the lift (n: there is none)."""
    samples = np.concatenate([stage.joints_rad for stage in motions.stages])
    names = [stage.name for stage in motions.stages for _ in stage.times_s]
    turns = np.diff(samples, axis=0)
    way = sum(
        np.linalg.norm(np.diff(arms.tips(samples, arm)[:, :3, 3], axis=0), axis=1)
        for arm in ("cutter", "holder")
    )
    # Beyond the tips' own way, the electrode's rear end turns about its tip.
    counts = np.maximum(np.ceil((way + 100 * np.abs(turns).max(1)) / step_mm), 1).astype(int)
    at = np.repeat(np.arange(len(turns)), counts)
    steps = np.arange(len(at)) - np.repeat(np.cumsum(counts) - counts, counts)
    joints = samples[at] + (steps / counts[at])[:, None] * turns[at]
    joints = np.vstack([joints, samples[-1:]])
    if LIFT not in names:
        return joints, len(joints)
    return joints, int(counts[: names.index(LIFT)].sum())


def least_mm(
    urdf: str,
    motions: Motions,
    mesh: Mesh,
    electrode_mm: float,
    carried: bool,
    step_mm: float = 0.3,
) -> float:
    """The least distance of the electrode, a cylinder with flat ends, from a surface's points;
    ``carried``: it moves with the holder from the lift on. Coarsely first: no pose is left out
    that could count."""
    arms = SlowArms(urdf)
    joints, lift = configurations(arms, motions, step_mm)
    tips = arms.tips(joints, "cutter")
    if carried and lift < len(joints):
        holder = arms.tips(joints, "holder")
        back = np.linalg.inv(holder[lift:]) if lift else np.linalg.inv(holder)
        start = holder[min(lift, len(holder) - 1)]
        tips[lift:] = start @ back @ tips[lift:]
    fine = mesh.spread_mm(0.6)
    middle = mesh.box_mm.mean(0)
    reach = float(np.linalg.norm(mesh.vertices_mm - middle, axis=1).max())
    away = _to_cylinders(middle[None], tips, electrode_mm).min(1)
    near = np.flatnonzero(away < away.min() + reach + _COARSE_MM)
    coarse = mesh.spread_mm(2 * _COARSE_MM)
    rough = _least_of_each(coarse, tips[near], electrode_mm)
    near = near[rough < rough.min() + 2 * _COARSE_MM]
    return float(_least_of_each(fine, tips[near], electrode_mm).min())


def _least_of_each(points_mm: np.ndarray, tips: Frames, electrode_mm: float) -> np.ndarray:
    count = max(1, _AT_ONCE // len(points_mm))
    return np.concatenate([
        _to_cylinders(points_mm, tips[first : first + count], electrode_mm).min(1)
        for first in range(0, len(tips), count)
    ])  # fmt: skip


def _to_cylinders(points_mm: np.ndarray, tips: Frames, electrode_mm: float) -> np.ndarray:
    """Of each point from each electrode (n, m); 0: inside it."""
    ahead = tips[:, :3, 0]
    origin = points_mm.mean(0)
    at, points = tips[:, :3, 3] - origin, points_mm - origin
    along = ahead @ points.T - (ahead * at).sum(1)[:, None]  # from the tip, forward
    squares = (points**2).sum(1) - 2 * at @ points.T + (at**2).sum(1)[:, None]
    aside = np.sqrt(np.maximum(squares - along**2, 0)) - ELECTRODE_RADIUS_MM
    beyond = np.maximum(along, -electrode_mm - along)
    return np.hypot(np.maximum(aside, 0), np.maximum(beyond, 0))
