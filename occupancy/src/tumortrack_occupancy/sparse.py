"""The answer on fine lattices from few queries: coarse points first, then only where they do not
settle the label.

Every rule refines the same way (``refined``): halfway between the points of a lattice logits are
first taken as linear; then a policy queries the network where that is not enough: ``_connected``
all that touches the organ, ``_uncertain`` where linear logits do not settle the label.

``sparse_margins`` goes on so from a lattice of at most ``START_MM`` down to voxels. What it may
miss: a part that no lattice point lies in and that does not show in the logits about it either. A
ball of START_MM times the square root of 3 always holds a lattice point: 6.9 mm, 0.17 ml, where
``prepare`` drops tumors of less than 0.2 ml by default.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int

from tumortrack.core.types import OUTSIDE
from tumortrack_occupancy import kernels, volume
from tumortrack_occupancy.kernels import leading
from tumortrack_occupancy.volume import LogitLattice, LogitsAt, Rows

START_MM = 4.0
_PROBE = 512  # of the least certain points, queried to learn how far linear logits are off
_SURPRISE = 0.5  # of the interpolation limit
_FIRST_SEEN = 0.1  # of a first lattice's points may lie near a surface

Flat = Int[np.ndarray, " n"]  # indices of points


@dataclass(frozen=True, eq=False)
class _Level:
    """A lattice of half the step of a ``coarse`` one, which can be queried at flat indices."""

    logits_at: LogitsAt
    coarse: LogitLattice
    shape: tuple[int, int, int]

    def query(self, flat: Flat) -> Rows:
        """The network's logits."""
        parts, step_mm = [], self.coarse.step_mm / 2
        for first in range(0, len(flat), volume.AT_ONCE):
            index = np.unravel_index(flat[first : first + volume.AT_ONCE], self.shape)
            points = np.stack(index, axis=1) * step_mm + self.coarse.origin_mm
            parts.append(self.logits_at(points.astype(np.float32)).float().cpu().numpy())
        return np.concatenate(parts)

    def known(self) -> Bool[np.ndarray, " n"]:
        """The coarse points."""
        known = np.zeros(self.shape, bool)
        known[::2, ::2, ::2] = True
        return known.ravel()


Policy = Callable[[_Level, Rows], None]  # replaces rows by answers


def refined(logits_at: LogitsAt, coarse: LogitLattice, policy: Policy) -> LogitLattice:
    """The lattice of half the step: linear logits, and the network's where the policy puts them."""
    i, j, k = (2 * n - 1 for n in coarse.logits.shape[:3])
    logits = np.empty((i, j, k, coarse.logits.shape[3]), np.float32)
    _in_slabs(partial(kernels.halved, coarse.logits, logits), i)
    policy(_Level(logits_at, coarse, (i, j, k)), logits.reshape(-1, logits.shape[3]))
    return LogitLattice(coarse.origin_mm, coarse.step_mm / 2, logits)


def organ_lattice(logits_at: LogitsAt, box_mm: volume.Box, steps: int) -> LogitLattice:
    """``lattice_over``, queried everywhere inside the organ and a point or two about it. Every
    second point along each axis is queried first. Whatever is connected to a part that holds one of
    these points is found as if all were queried; what lies apart and between them is not, and would
    be dropped (``volume.keep_largest_pieces``)."""
    return refined(logits_at, volume.lattice_over(logits_at, box_mm, -(-steps // 2)), _connected)


def halved_lattice(logits_at: LogitsAt, lattice: LogitLattice) -> LogitLattice:
    """The lattice of half the step, queried where linear logits do not settle the label."""
    return refined(logits_at, lattice, partial(_uncertain, InterpolationLimit()))


def sparse_margins(
    logits_at: LogitsAt,
    camera_from_index: volume.Affine,
    shape: tuple[int, int, int],
    start_mm: float = START_MM,
) -> tuple[volume.Margins, volume.Labels]:
    """The ``margins_of`` the parts, and labels, at the centres of cubic voxels along the camera's
    axes; far from all surfaces margins are the largest there are, between them and the queried
    voxels linear. ``start_mm``: largest step of the first lattice."""
    voxel_mm, origin_mm = float(camera_from_index[0, 0]), camera_from_index[:3, 3]
    levels = max(0, int(np.floor(np.log2(max(start_mm / voxel_mm, 1.0)))))
    stride, (i, j, k) = 2**levels, shape
    if levels > 0:
        i, j, k = ((n - 2) // stride + 2 for n in shape)  # the last on the grid's end or past it
    step_mm = voxel_mm * stride
    unknown = LogitLattice(origin_mm, 2 * step_mm, np.empty((0, 0, 0, 0), np.float32))
    logits = _Level(logits_at, unknown, (i, j, k)).query(np.arange(i * j * k))
    lattice = LogitLattice(origin_mm, step_mm, logits.reshape(i, j, k, -1))
    if levels == 0:
        return volume.margins_on(lattice)[:2]
    limit = InterpolationLimit()
    for _ in range(levels - 1):
        limit = limit.finer()
        lattice = refined(logits_at, lattice, partial(_uncertain, limit))
    return _voxels(_Level(logits_at, lattice, shape), limit.finer())


def sparse_logits(logits_at: LogitsAt, lattice: LogitLattice, points_mm: volume.Points) -> Rows:
    """Logits at points in a lattice's box: linear where the label is certain, else queried.
    Scattered points are counted, nobody sees one alone: less care than for voxels, half of the
    queries (networks tried: none to three of 40,000 labels other than those of querying all)."""
    logits = lattice.between(points_mm)

    def query(some: Flat) -> Rows:
        return logits_at(points_mm[some]).float().cpu().numpy()

    query_uncertain(logits, leading(logits)[1], query, InterpolationLimit(tail=0.99, safety=1.0))
    return logits


@dataclass(eq=False)
class InterpolationLimit:
    """How far linear logits were found to be off: a label that leads by more is accepted. It is a
    quantile, ``tail``, of the errors found, times ``safety``. ``coarser``: the limit at twice the
    step, 0 where there was none."""

    limit: float = 0.0
    coarser: float = 0.0
    tail: float = 0.999
    safety: float = 1.5
    errors: list[np.ndarray] = field(default_factory=list)

    def update(self, expected: np.ndarray, found: np.ndarray) -> None:
        """From logits (n, classes) that were expected, and those that were found."""
        rows, order = np.arange(len(expected)), np.argpartition(expected, -2, axis=1)
        first, second = order[:, -1], order[:, -2]
        lead, true = (of[rows, first] - of[rows, second] for of in (expected, found))
        self.errors.append(np.abs(lead - true))
        worst = float(np.quantile(np.concatenate(self.errors), self.tail))
        self.limit = max(self.limit, self.safety * worst)

    def finer(self) -> InterpolationLimit:
        """At half the step, before any query: errors of smooth logits are a quarter."""
        return InterpolationLimit(self.limit / 4, self.limit)


def query_uncertain(
    expected: Rows,
    leads: Float32[np.ndarray, " n"],
    query: Callable[[Flat], Rows],
    limit: InterpolationLimit,
) -> Bool[np.ndarray, " n"]:
    """Query wherever the expected label leads by too little; which were queried. The least certain
    points come first. How far their logits are off tells which of the others have to be queried as
    well, until none is left. ``expected``: logits, replaced by the answers; ``leads``: by how much
    the largest exceeds the second, infinite where it is known already; ``limit``: updated by the
    answers."""
    queried = np.zeros(len(leads), bool)
    open_points = int(np.isfinite(leads).sum())
    if open_points:
        least = min(_PROBE, open_points) - 1
        limit.limit = max(limit.limit, float(np.partition(leads, least)[least]))
    while len(now := np.flatnonzero((leads <= limit.limit) & ~queried)):
        found = query(now)
        limit.update(expected[now], found)
        expected[now] = found
        queried[now] = True
    return queried


def _connected(level: _Level, rows: Rows) -> None:
    """Query all points within two of a coarse one that lies inside, then all about those that turn
    out to lie inside, until none is left."""

    def inside(flat: np.ndarray) -> np.ndarray:
        return flat[rows[flat].argmax(1) != OUTSIDE]

    known = level.known()
    first = kernels.neighbours(level.shape, inside(np.flatnonzero(known)), known)
    frontier = np.concatenate([first, kernels.neighbours(level.shape, first, known)])
    while len(frontier):
        rows[frontier] = level.query(frontier)
        frontier = kernels.neighbours(level.shape, inside(frontier), known)


def _uncertain(limit: InterpolationLimit, level: _Level, rows: Rows) -> None:
    """Query where the leading label leads by less than linear logits were found to be off, and
    about surprises."""
    leads = leading(rows)[1]
    leads[level.known()] = np.inf
    queried = np.flatnonzero(query_uncertain(rows, leads, level.query, limit))
    flat, found = _about_surprises(level, limit.limit, queried, rows[queried])
    rows[flat] = found


def _voxels(level: _Level, limit: InterpolationLimit) -> tuple[volume.Margins, volume.Labels]:
    """Margins and labels of the voxels. As ``_uncertain``, but logits of voxels far from surfaces
    are never held: a cell whose corners lead clearly is filled with their label, and margins there
    are the largest."""
    coarse = level.coarse.logits
    rows = coarse.reshape(-1, coarse.shape[3])
    certain, leads = (values.reshape(coarse.shape[:3]) for values in leading(rows))
    labels = np.empty(level.shape, np.uint8)

    def uncertain(flat: Flat, expected: Rows, between: np.ndarray) -> np.ndarray:
        lead = leading(expected)[1]
        lead[~between] = np.inf
        return query_uncertain(expected, lead, lambda some: level.query(flat[some]), limit)

    seen = limit.coarser or float(np.quantile(leads, _FIRST_SEEN))
    while True:
        plain = np.where(leads >= np.float32(seen), certain, np.uint8(255))
        lists = _in_slabs(partial(kernels.filled, coarse, certain, plain, labels), len(coarse))
        flat, expected, between = (np.concatenate(column) for column in zip(*lists, strict=True))
        queried = uncertain(flat, expected, between)
        if limit.limit <= seen:
            break
        seen = 2 * limit.limit  # voxels that lead by less were filled unseen
    more, found = _about_surprises(level, limit.limit, flat[queried], expected[queried])
    places, logits = np.concatenate([flat, more]), np.concatenate([expected, found])
    labels.reshape(-1)[places] = leading(logits)[0]
    margins = np.empty((logits.shape[1] - 1, *labels.shape), np.float16)
    most = volume.LARGEST_MARGIN
    inside, outside = np.array([most, -most], np.float16).view(np.uint16)
    spread = partial(kernels.spread, labels, inside, outside, margins.view(np.uint16))
    _in_slabs(spread, len(labels))
    for margin, won in zip(margins, volume.margins_of(torch.from_numpy(logits)).T, strict=True):
        margin.reshape(-1)[places] = won
    return margins, labels


def _about_surprises(
    level: _Level, limit: float, flat: Flat, found: Rows
) -> tuple[Int[np.ndarray, " m"], Float32[np.ndarray, "m classes"]]:
    """Query every point that touches a surprise, until there is none; indices and logits. A
    surprise is another label than expected, by more than ``_SURPRISE`` of the ``limit``, since
    linear logits are a little off everywhere. ``flat`` and ``found``: the points queried before,
    and their logits."""
    surprises = partial(
        kernels.surprising, level.coarse.logits, level.shape, limit=np.float32(_SURPRISE * limit)
    )
    more, logits, surprised = [flat[:0]], [found[:0]], surprises(flat, found)
    if len(surprised):
        known = level.known()
        known[flat] = True
    while len(surprised) and len(flat := kernels.neighbours(level.shape, surprised, known)):
        more.append(flat)
        logits.append(found := level.query(flat))
        surprised = surprises(flat, found)
    return np.concatenate(more), np.concatenate(logits)


def _in_slabs(work: Callable[[int, int], object], planes: int) -> list[Any]:
    """What ``work(first, last)`` returns for slabs of planes, one a thread."""
    cuts = np.linspace(0, planes, torch.get_num_threads() + 1).astype(int)
    with ThreadPoolExecutor(len(cuts) - 1) as pool:
        return list(pool.map(work, cuts[:-1], cuts[1:]))
