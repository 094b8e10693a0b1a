"""Where the electrode is while it cuts, sweep by sweep: what it covers, and how near it comes to
what. For pictures: what a plan is judged by is ``check``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack.core.colours import Colour, sweep_colour
from tumortrack.core.mesh_query import contains
from tumortrack.core.organ import is_tumor
from tumortrack.core.types import Mesh
from tumortrack_resection.facets import Tools, Vector
from tumortrack_resection.values import Located, ResectionPlan

_ALONG_MM = 0.5  # between points of an electrode
_SURFACE_MM = 1.0  # of surfaces
_COMING_MM = 2.0, 18.0  # outside the organ
_JUMP_MM = 5.0  # between poses farther apart nothing is covered

Lines = Float64[np.ndarray, "n 2 3"]  # tip and rear end of the bare electrode's axis, mm


class Near(NamedTuple):
    """How near the electrode comes to a part in a sweep, mm (negative: its axis goes so deep into
    it), at which pose, and the places on its axis and on the part's surface."""

    mm: float
    pose: int
    axis_mm: Vector
    part_mm: Vector


@dataclass(frozen=True, eq=False)
class Sweep:
    """The electrode in one sweep, pose by pose.

    Attributes:
        paths_mm: of the tip, stroke by stroke.
        lines: of the electrode; none where it is held level and no motions are known.
        exits_mm: how far from its tip each of them leaves the organ; NaN: it is outside.
        near: to each tumor, and to what else it keeps away from; empty without lines.
    """

    number: int
    colour: Colour
    paths_mm: tuple[Float64[np.ndarray, "_ 3"], ...]
    lines: Lines
    exits_mm: Float64[np.ndarray, " n"]
    near: dict[str, Near]

    @property
    def back(self) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors from the tips to where the instrument comes from."""
        along = self.lines[:, 1] - self.lines[:, 0]
        return along / np.linalg.norm(along, axis=1, keepdims=True)

    def along(self, pose: int, beyond_mm: float = 0.0) -> Vector:
        """The place where the electrode leaves the organ, or so far outside; of one that is
        outside, from its tip."""
        out_mm = np.nan_to_num(self.exits_mm[pose]) + beyond_mm
        return self.lines[pose, 0] + out_mm * self.back[pose]

    def coming(self, share: float) -> Float64[np.ndarray, "2 3"]:
        """After this share of the sweep, two places in line with the electrode outside the organ,
        the nearer one first."""
        inside = np.flatnonzero(np.isfinite(self.exits_mm))
        poses = inside if len(inside) else np.arange(len(self.lines))
        pose = int(poses[int(share * (len(poses) - 1))])
        return np.stack([self.along(pose, beyond_mm) for beyond_mm in _COMING_MM])

    def strip(self) -> Mesh:
        """What the electrode covers from its tip to where it leaves the organ: an open surface."""
        inside = np.isfinite(self.exits_mm)
        far = self.lines[:, 0] + np.nan_to_num(self.exits_mm)[:, None] * self.back
        near_mm = np.linalg.norm(np.diff(self.lines[:, 0], axis=0), axis=1) < _JUMP_MM
        first = 2 * np.flatnonzero(inside[1:] & inside[:-1] & near_mm)[:, None]
        vertices = np.stack([self.lines[:, 0], far], axis=1).reshape(-1, 3)
        return Mesh(vertices, np.concatenate([first + [0, 2, 3], first + [0, 3, 1]]))


def sweeps_of(
    plan: ResectionPlan, located: Located, tools: Tools, poses_mm: Lines | None = None
) -> list[Sweep]:
    """In their order. ``poses_mm``: of the electrode while it cuts; only cuts without a direction
    need them, and each gets those whose tips are nearest to it."""
    lines = {n: [np.zeros((0, 2, 3))] for n in range(1, plan.sweeps + 1)}
    for cut in plan.cuts:
        if cut.axis is not None:
            rear_mm = cut.path_mm - tools.electrode_mm * cut.axis
            lines[cut.sweep].append(np.stack([cut.path_mm, rear_mm], axis=1))
    level = [cut for cut in plan.cuts if cut.axis is None]
    if poses_mm is not None and level:
        off_mm = [cKDTree(cut.path_mm).query(poses_mm[:, 0])[0] for cut in level]
        owner = np.array([cut.sweep for cut in level])[np.argmin(off_mm, axis=0)]
        for cut in level:
            lines[cut.sweep] = [poses_mm[owner == cut.sweep]]
    surfaces = {**located.meshes, **located.structures}
    parts = {name: _Surface(mesh) for name, mesh in surfaces.items()
             if is_tumor(name) or name in plan.keep_mm}  # fmt: skip
    sweeps = []
    for n, strokes in lines.items():
        each = np.concatenate(strokes)
        shares = np.linspace(0, 1, round(tools.electrode_mm / _ALONG_MM) + 1)
        points = each[:, :1] + shares[:, None] * (each[:, 1:] - each[:, :1])
        inside = contains(located.organ, points.reshape(-1, 3)).reshape(points.shape[:2])
        last = len(shares) - 1 - inside[:, ::-1].argmax(1)
        exits_mm = np.where(inside.any(1), shares[last] * tools.electrode_mm, np.nan)
        some = points[:, ::2]
        near = {name: part.near(some, tools) for name, part in parts.items() if len(some)}
        paths_mm = tuple(cut.path_mm for cut in plan.cuts if cut.sweep == n)
        sweeps.append(Sweep(n, sweep_colour(n, plan.sweeps), paths_mm, each, exits_mm, near))
    return sweeps


class _Surface:
    """A part."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh, self._tree = mesh, cKDTree(mesh.spread_mm(_SURFACE_MM))

    def near(self, points_mm: Float64[np.ndarray, "n m 3"], tools: Tools) -> Near:
        """Of electrodes, by points on their axes from the tip on; their ends are flat."""
        flat_mm, mesh = points_mm.reshape(-1, 3), self._mesh
        away_mm, at = self._tree.query(flat_mm)
        part_mm = self._tree.data[at]
        inside = contains(mesh, flat_mm) if mesh.closed else np.zeros(len(flat_mm), bool)
        if inside.any():
            n = int(np.where(inside, away_mm, -1.0).argmax())
            mm = -away_mm[n]
        else:
            along = points_mm[:, :1] - points_mm[:, -1:]  # ahead, as long as the electrode
            long_mm = np.linalg.norm(along, axis=2)
            off_mm = part_mm.reshape(points_mm.shape) - points_mm[:, :1]
            ahead_mm = (off_mm * along).sum(2) / long_mm
            aside_mm = np.sqrt(np.maximum((off_mm**2).sum(2) - ahead_mm**2, 0.0))
            beyond_mm = np.maximum(ahead_mm, -long_mm - ahead_mm)
            gap_mm = np.hypot(*np.maximum([beyond_mm, aside_mm - tools.radius_mm], 0.0))
            n = int(gap_mm.argmin())
            mm = gap_mm.ravel()[n]
        return Near(float(mm), n // points_mm.shape[1], flat_mm[n], part_mm[n])
