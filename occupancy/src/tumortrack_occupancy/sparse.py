"""Logits on fine lattices from few queries: coarse points first, then only where the label is
uncertain.

A lattice is refined (``refined``) by linear interpolation halfway between its points; then a policy
queries the network where that is not enough: ``_connected`` everything that touches the organ,
``_uncertain`` where linear logits leave the label uncertain.

``sparse_margins`` refines a lattice of at most ``START_MM`` down to voxels. It may miss a part that
contains no lattice point and does not show in the logits around it either. A ball of START_MM times
the square root of 3 in diameter always contains one: 6.9 mm, 0.17 ml; ``prepare`` drops tumors of
less than 0.2 ml by default.
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
_PROBE = 512  # least certain points, queried to measure the error of linear logits
_MISPREDICTED = 0.5  # of the interpolation limit
_NEAR_SURFACE = 0.1  # largest fraction of a first lattice's points near a surface

Flat = Int[np.ndarray, " n"]  # indices of points


@dataclass(frozen=True, eq=False)
class _Level:
    """A lattice of half the step of ``coarse``, which can be queried at flat indices."""

    logits_at: LogitsAt
    coarse: LogitLattice
    shape: tuple[int, int, int]

    def query(self, flat: Flat) -> Rows:
        parts, step_mm = [], self.coarse.step_mm / 2
        for first in range(0, len(flat), volume.AT_ONCE):
            index = np.unravel_index(flat[first : first + volume.AT_ONCE], self.shape)
            points = np.stack(index, axis=1) * step_mm + self.coarse.origin_mm
            parts.append(self.logits_at(points.astype(np.float32)).float().cpu().numpy())
        return np.concatenate(parts)

    def known(self) -> Bool[np.ndarray, " n"]:
        """Which points are those of the coarse lattice."""
        known = np.zeros(self.shape, bool)
        known[::2, ::2, ::2] = True
        return known.ravel()


Policy = Callable[[_Level, Rows], None]  # replaces some linear logits by queried ones


def refined(logits_at: LogitsAt, coarse: LogitLattice, policy: Policy) -> LogitLattice:
    """The lattice of half the step: linear logits, and the network's where the policy queries."""
    i, j, k = (2 * n - 1 for n in coarse.logits.shape[:3])
    logits = np.empty((i, j, k, coarse.logits.shape[3]), np.float32)
    _in_slabs(partial(kernels.halved, coarse.logits, logits), i)
    policy(_Level(logits_at, coarse, (i, j, k)), logits.reshape(-1, logits.shape[3]))
    return LogitLattice(coarse.origin_mm, coarse.step_mm / 2, logits)


def organ_lattice(logits_at: LogitsAt, box_mm: volume.Box, steps: int) -> LogitLattice:
    """``lattice_over``, queried everywhere inside the organ and up to two points around it. Every
    second point along each axis is queried first. All that is connected to a part containing one of
    these points is found as if every point were queried. Separate pieces between them are not, and
    would be dropped anyway (``volume.keep_largest_pieces``)."""
    return refined(logits_at, volume.lattice_over(logits_at, box_mm, -(-steps // 2)), _connected)


def halved_lattice(logits_at: LogitsAt, lattice: LogitLattice) -> LogitLattice:
    """The lattice of half the step, queried where linear logits leave the label uncertain."""
    return refined(logits_at, lattice, partial(_uncertain, InterpolationLimit()))


def sparse_margins(
    logits_at: LogitsAt,
    camera_from_index: volume.Affine,
    shape: tuple[int, int, int],
    start_mm: float = START_MM,
) -> tuple[volume.Margins, volume.Labels]:
    """Margins of the parts (``margins_of``) and labels at the centres of cubic voxels along the
    camera's axes. Far from all surfaces margins have the largest magnitude; closer, they are linear
    where the network is not queried. ``start_mm``: largest step of the first lattice."""
    voxel_mm, origin_mm = float(camera_from_index[0, 0]), camera_from_index[:3, 3]
    levels = max(0, int(np.floor(np.log2(max(start_mm / voxel_mm, 1.0)))))
    stride, (i, j, k) = 2**levels, shape
    if levels > 0:
        i, j, k = ((n - 2) // stride + 2 for n in shape)  # the last at the grid's end or beyond
    step_mm = voxel_mm * stride
    none = LogitLattice(origin_mm, 2 * step_mm, np.empty((0, 0, 0, 0), np.float32))
    logits = _Level(logits_at, none, (i, j, k)).query(np.arange(i * j * k))
    lattice = LogitLattice(origin_mm, step_mm, logits.reshape(i, j, k, -1))
    if levels == 0:
        return volume.margins_on(lattice)[:2]
    limit = InterpolationLimit()
    for _ in range(levels - 1):
        limit = limit.finer()
        lattice = refined(logits_at, lattice, partial(_uncertain, limit))
    return _voxels(_Level(logits_at, lattice, shape), limit.finer())


def sparse_logits(logits_at: LogitsAt, lattice: LogitLattice, points_mm: volume.Points) -> Rows:
    """Logits at points in a lattice's box: linear where the label is certain, else queried. The
    limit is looser than for voxels, with half of the queries, since only the points' statistics are
    used (networks tried: none to three of 40,000 labels differ from querying all)."""
    logits = lattice.interpolate(points_mm)

    def query(some: Flat) -> Rows:
        return logits_at(points_mm[some]).float().cpu().numpy()

    query_uncertain(logits, leading(logits)[1], query, InterpolationLimit(tail=0.99, safety=1.0))
    return logits


@dataclass(eq=False)
class InterpolationLimit:
    """The error of linear logits, measured at queried points: a label that leads by more is
    accepted. ``limit`` is the quantile ``tail`` of the errors times ``safety``; ``coarser`` that at
    twice the step, 0 if there was none."""

    limit: float = 0.0
    coarser: float = 0.0
    tail: float = 0.999
    safety: float = 1.5
    errors: list[np.ndarray] = field(default_factory=list)

    def update(self, expected: np.ndarray, queried: np.ndarray) -> None:
        """From expected and queried logits (n, classes)."""
        rows, order = np.arange(len(expected)), np.argpartition(expected, -2, axis=1)
        first, second = order[:, -1], order[:, -2]
        lead, true = (of[rows, first] - of[rows, second] for of in (expected, queried))
        self.errors.append(np.abs(lead - true))
        worst = float(np.quantile(np.concatenate(self.errors), self.tail))
        self.limit = max(self.limit, self.safety * worst)

    def finer(self) -> InterpolationLimit:
        """At half the step, before any query: linear interpolation's error is a quarter."""
        return InterpolationLimit(self.limit / 4, self.limit)


def query_uncertain(
    expected: Rows,
    leads: Float32[np.ndarray, " n"],
    query: Callable[[Flat], Rows],
    limit: InterpolationLimit,
) -> Bool[np.ndarray, " n"]:
    """Query wherever the expected label leads by too little; returns which points were queried. The
    least certain ones come first; the error of their logits determines which others are queried as
    well, until none is left. ``expected``: logits, replaced by the queried ones; ``leads``: by how
    much the largest exceeds the second, infinite where it is known; ``limit``: updated."""
    queried = np.zeros(len(leads), bool)
    open_points = int(np.isfinite(leads).sum())
    if open_points:
        least = min(_PROBE, open_points) - 1
        limit.limit = max(limit.limit, float(np.partition(leads, least)[least]))
    while len(now := np.flatnonzero((leads <= limit.limit) & ~queried)):
        logits = query(now)
        limit.update(expected[now], logits)
        expected[now] = logits
        queried[now] = True
    return queried


def _connected(level: _Level, rows: Rows) -> None:
    """Query all points within two steps of a coarse point inside the organ, then all neighbours of
    those that turn out to be inside, until none is left."""

    def inside(flat: np.ndarray) -> np.ndarray:
        return flat[rows[flat].argmax(1) != OUTSIDE]

    known = level.known()
    first = kernels.neighbours(level.shape, inside(np.flatnonzero(known)), known)
    frontier = np.concatenate([first, kernels.neighbours(level.shape, first, known)])
    while len(frontier):
        rows[frontier] = level.query(frontier)
        frontier = kernels.neighbours(level.shape, inside(frontier), known)


def _uncertain(limit: InterpolationLimit, level: _Level, rows: Rows) -> None:
    """Query where the label leads by less than the error of linear logits, and around mispredicted
    points."""
    leads = leading(rows)[1]
    leads[level.known()] = np.inf
    queried = np.flatnonzero(query_uncertain(rows, leads, level.query, limit))
    flat, logits = _around_mispredicted(level, limit.limit, queried, rows[queried])
    rows[flat] = logits


def _voxels(level: _Level, limit: InterpolationLimit) -> tuple[volume.Margins, volume.Labels]:
    """Margins and labels of the voxels. Queries as ``_uncertain``, but never stores logits of
    voxels far from surfaces: a cell whose corners are certain is filled with their label and with
    margins of the largest magnitude."""
    coarse = level.coarse.logits
    rows = coarse.reshape(-1, coarse.shape[3])
    coarse_labels, leads = (values.reshape(coarse.shape[:3]) for values in leading(rows))
    labels = np.empty(level.shape, np.uint8)

    def uncertain(flat: Flat, expected: Rows, between: np.ndarray) -> np.ndarray:
        lead = leading(expected)[1]
        lead[~between] = np.inf
        return query_uncertain(expected, lead, lambda some: level.query(flat[some]), limit)

    threshold = limit.coarser or float(np.quantile(leads, _NEAR_SURFACE))
    while True:
        certain = np.where(leads >= np.float32(threshold), coarse_labels, np.uint8(255))
        fill = partial(kernels.fill_cells, coarse, coarse_labels, certain, labels)
        lists = _in_slabs(fill, len(coarse))
        flat, expected, between = (np.concatenate(column) for column in zip(*lists, strict=True))
        queried = uncertain(flat, expected, between)
        if limit.limit <= threshold:
            break
        threshold = 2 * limit.limit  # voxels that lead by less were filled
    more, more_logits = _around_mispredicted(level, limit.limit, flat[queried], expected[queried])
    flat, logits = np.concatenate([flat, more]), np.concatenate([expected, more_logits])
    labels.reshape(-1)[flat] = leading(logits)[0]
    margins = np.empty((logits.shape[1] - 1, *labels.shape), np.float16)
    # As integers: NumPy takes ten times as long to choose one of two floats.
    most = volume.LARGEST_MARGIN
    inside, outside = np.array([most, -most], np.float16).view(np.uint16)
    for part, bits in enumerate(margins.view(np.uint16)):
        within = labels > 0 if part == 0 else labels == part + 1  # all are inside the first one
        np.multiply(within, inside ^ outside, out=bits)
        bits ^= outside
    exact = volume.margins_of(torch.from_numpy(logits)).T
    margins.reshape(len(margins), -1)[:, flat] = exact
    return margins, labels


def _around_mispredicted(
    level: _Level, limit: float, flat: Flat, logits: Rows
) -> tuple[Int[np.ndarray, " m"], Float32[np.ndarray, "m classes"]]:
    """Query all neighbours of mispredicted points, until there is no further one; returns indices
    and logits. Mispredicted: another label than linear logits predict, by more than
    ``_MISPREDICTED`` of the ``limit``, since linear logits are a little off everywhere. ``flat``,
    ``logits``: the points queried so far."""
    most = _MISPREDICTED * limit
    wrong_of = partial(kernels.mispredicted, level.coarse.logits, level.shape, limit=most)
    more_flat, more_logits, wrong = [flat[:0]], [logits[:0]], wrong_of(flat, logits)
    if len(wrong):
        known = level.known()
        known[flat] = True
    while len(wrong) and len(flat := kernels.neighbours(level.shape, wrong, known)):
        logits = level.query(flat)
        more_flat.append(flat)
        more_logits.append(logits)
        wrong = wrong_of(flat, logits)
    return np.concatenate(more_flat), np.concatenate(more_logits)


def _in_slabs(work: Callable[[int, int], object], planes: int) -> list[Any]:
    """The results of ``work(first, last)`` on slabs of planes, one per thread."""
    cuts = np.linspace(0, planes, torch.get_num_threads() + 1).astype(int)
    with ThreadPoolExecutor(len(cuts) - 1) as pool:
        return list(pool.map(work, cuts[:-1], cuts[1:]))
