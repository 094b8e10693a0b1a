"""The dense answer from few questions: coarse first, then only where it is not plain.

A lattice of at most ``START_MM`` is asked. Halfway between its points the logits are first taken as
linear, then asked for wherever the label that leads does so by less than linear logits were found
to err (``settled``); and so on, down to the voxels. Where an answer is another label than was
expected, and by more than noise, the voxels about it are asked as well.

What it may miss: a part that no lattice point lies in and that does not show in the logits about it
either. A ball of START_MM times the square root of 3 always holds a lattice point: 6.9 mm, 0.17 ml,
where ``prepare`` drops tumors of less than 0.2 ml unless it is told otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Float64, Int, UInt8

from tumortrack.core.geometry import transform_points
from tumortrack.occupancy.lattice import LogitLattice, LogitsAt
from tumortrack.occupancy.volume import LARGEST_MARGIN, dense_margins, margins_of

START_MM = 4.0
_AT_ONCE = 2**18  # queries
_PROBE = 512  # of the least sure points, asked to learn how much linear logits err
_SURPRISE = 0.5  # of what is believed of linear logits
_FIRST_SEEN = 0.1  # of a first lattice's points may lie near a surface

Ask = Callable[[Int[np.ndarray, " n"]], Float32[np.ndarray, "n classes"]]


def sparse_margins(
    logits_at: LogitsAt,
    camera_from_index: Float64[np.ndarray, "4 4"],
    shape: tuple[int, int, int],
    start_mm: float = START_MM,
) -> tuple[Float16[np.ndarray, "parts i j k"], UInt8[np.ndarray, "i j k"]]:
    """What ``dense_margins`` returns; far from all surfaces margins are the largest there are,
    between them and the asked voxels linear.

    Args:
        start_mm: distance of the first lattice's points at the most.
    """
    voxel_mm = float(camera_from_index[0, 0])
    levels = max(0, int(np.floor(np.log2(max(start_mm / voxel_mm, 1.0)))))
    if levels == 0:
        return dense_margins(logits_at, camera_from_index, shape)
    stride = 2**levels
    i, j, k = ((n - 2) // stride + 2 for n in shape)  # the last lies on the grid's end or past it
    lattice = _Lattice(logits_at, camera_from_index, (i, j, k), stride)
    logits = lattice.ask(np.arange(i * j * k)).reshape(i, j, k, -1)
    for _ in range(levels - 1):
        lattice = lattice.halved()
        logits = _halved(logits, lattice)
    return _voxels(logits, replace(lattice.halved(), shape=shape))


def sparse_logits(
    logits_at: LogitsAt, lattice: LogitLattice, points_mm: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n classes"]:
    """Logits at points in a lattice's box: linear where the label is plain, else asked for.

    Scattered points are counted, nobody sees one alone: less care than for voxels, half of the
    questions (networks tried: none to three of 40,000 labels other than those of asking all).
    """
    logits = lattice.between(points_mm)

    def ask(some: Int[np.ndarray, " m"]) -> Float32[np.ndarray, "m classes"]:
        return logits_at(points_mm[some]).float().cpu().numpy()

    settled(logits, leading(logits)[1], ask, InterpolationLimit(tail=0.99, safety=1.0))
    return logits


def halved_lattice(logits_at: LogitsAt, lattice: LogitLattice) -> LogitLattice:
    """The lattice of half the step, asked where linear logits do not tell the label."""
    step_mm = lattice.step_mm / 2
    camera_from_index = np.diag([step_mm] * 3 + [1.0])
    camera_from_index[:3, 3] = lattice.origin_mm
    i, j, k = (2 * n - 1 for n in lattice.logits.shape[:3])
    finer = _Lattice(logits_at, camera_from_index, (i, j, k), 1)
    return LogitLattice(lattice.origin_mm, step_mm, _halved(lattice.logits, finer))


@dataclass(eq=False)
class InterpolationLimit:
    """How far linear logits were found to be off: a label that leads by ``limit`` is believed.

    ``coarser``: the limit at twice the distance, 0 where there was none. The limit is a quantile,
    ``tail``, of the errors found, times ``safety``.
    """

    limit: float = 0.0
    coarser: float = 0.0
    tail: float = 0.999
    safety: float = 1.5
    errors: list[np.ndarray] = field(default_factory=list)

    def learn(self, expected: np.ndarray, found: np.ndarray) -> None:
        """From logits (n, classes) that were expected, and those that were found."""
        rows, order = np.arange(len(expected)), np.argpartition(expected, -2, axis=1)
        first, second = order[:, -1], order[:, -2]
        lead, true = (of[rows, first] - of[rows, second] for of in (expected, found))
        self.errors.append(np.abs(lead - true))
        worst = float(np.quantile(np.concatenate(self.errors), self.tail))
        self.limit = max(self.limit, self.safety * worst)

    def finer(self) -> InterpolationLimit:
        """At half the distance, before anything is asked: smooth logits err by a quarter."""
        return InterpolationLimit(self.limit / 4, self.limit)


@dataclass(eq=False)
class _Lattice:
    """Points that can be asked, ``stride`` voxels apart; ``trust`` in linear logits there."""

    logits_at: LogitsAt
    camera_from_index: Float64[np.ndarray, "4 4"]
    shape: tuple[int, int, int]
    stride: int
    trust: InterpolationLimit = field(default_factory=InterpolationLimit)

    def halved(self) -> _Lattice:
        i, j, k = (2 * n - 1 for n in self.shape)
        stride = self.stride // 2
        finer = self.trust.finer()
        return _Lattice(self.logits_at, self.camera_from_index, (i, j, k), stride, finer)

    def ask_some(
        self, flat: Int[np.ndarray, " n"], some: Int[np.ndarray, " m"]
    ) -> Float32[np.ndarray, "m classes"]:
        return self.ask(flat[some])

    def ask(self, flat: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n classes"]:
        parts = []
        for first in range(0, len(flat), _AT_ONCE):
            index = np.unravel_index(flat[first : first + _AT_ONCE], self.shape)
            places = np.stack(index, axis=1) * float(self.stride)
            points = transform_points(self.camera_from_index, places)
            parts.append(self.logits_at(points.astype(np.float32)).float().cpu().numpy())
        return np.concatenate(parts)


def settled(
    expected: Float32[np.ndarray, "n classes"],
    leads: Float32[np.ndarray, " n"],
    ask: Ask,
    trust: InterpolationLimit,
) -> Bool[np.ndarray, " n"]:
    """Ask wherever the expected label leads by too little; which were asked.

    The least sure points are asked first. How far their logits lie from the expected ones tells
    what the others may err by, and so which of them have to be asked as well, until none is left.

    Args:
        expected: logits; where asked, they are replaced by the answer.
        leads: by how much the largest is larger than the second.
        ask: indices (m,) -> logits (m, classes).
        trust: what is known of the errors; learns.
    """
    asked = np.zeros(len(leads), bool)
    uncertain = int(np.isfinite(leads).sum())  # others were settled before
    if uncertain:
        least = min(_PROBE, uncertain) - 1
        trust.limit = max(trust.limit, float(np.partition(leads, least)[least]))
    while True:
        now = np.flatnonzero((leads <= trust.limit) & ~asked)
        if not len(now):
            return asked
        found = ask(now)
        trust.learn(expected[now], found)
        expected[now] = found
        asked[now] = True


def _halved(
    coarse: Float32[np.ndarray, "a b c classes"], lattice: _Lattice
) -> Float32[np.ndarray, "i j k classes"]:
    """The logits of a lattice from those of the one before."""
    from tumortrack.occupancy.kernels import halved

    fine = np.empty((*lattice.shape, coarse.shape[3]), np.float32)
    _in_slabs(partial(halved, coarse, fine), len(fine))
    rows = fine.reshape(-1, coarse.shape[3])
    leads = leading(rows)[1]
    leads.reshape(lattice.shape)[::2, ::2, ::2] = np.inf  # the coarse points: settled before
    asked = np.flatnonzero(settled(rows, leads, lattice.ask, lattice.trust))
    flat, found = _about_surprises(asked, rows[asked], coarse, lattice)
    rows[flat] = found
    return fine


def _voxels(
    coarse: Float32[np.ndarray, "a b c classes"], lattice: _Lattice
) -> tuple[Float16[np.ndarray, "parts i j k"], UInt8[np.ndarray, "i j k"]]:
    """Margins and labels of the voxels, from the lattice of twice their distance."""
    from tumortrack.occupancy.kernels import filled

    classes = coarse.shape[3]
    sure, leads = (v.reshape(coarse.shape[:3]) for v in leading(coarse.reshape(-1, classes)))
    labels = np.empty(lattice.shape, np.uint8)
    trust = lattice.trust
    seen = trust.coarser or float(np.quantile(leads, _FIRST_SEEN))
    while True:
        plain = np.where(leads >= np.float32(seen), sure, np.uint8(255))
        lists = _in_slabs(partial(filled, coarse, sure, plain, labels), len(coarse))
        flat, expected, between = (np.concatenate(column) for column in zip(*lists, strict=True))
        lead = leading(expected)[1]
        lead[~between] = np.inf  # the coarse points: settled before
        asked = settled(expected, lead, partial(lattice.ask_some, flat), trust)
        if trust.limit <= seen:
            break
        seen = 2 * trust.limit  # voxels that lead by less were filled unseen
    more, found = _about_surprises(flat[asked], expected[asked], coarse, lattice)
    places, logits = np.concatenate([flat, more]), np.concatenate([expected, found])
    labels.reshape(-1)[places] = leading(logits)[0]
    return _margins(labels, places, logits), labels


def _margins(
    labels: UInt8[np.ndarray, "i j k"],
    places: Int[np.ndarray, " n"],
    logits: Float32[np.ndarray, "n classes"],
) -> Float16[np.ndarray, "parts i j k"]:
    """The largest everywhere but at these places (flat), whose logits are known."""
    from tumortrack.occupancy.kernels import spread

    margins = np.empty((logits.shape[1] - 1, *labels.shape), np.float16)
    inside, outside = np.array([LARGEST_MARGIN, -LARGEST_MARGIN], np.float16).view(np.uint16)
    _in_slabs(partial(spread, labels, inside, outside, margins.view(np.uint16)), len(labels))
    won = margins_of(torch.from_numpy(logits))
    for part, margin in enumerate(margins):
        margin.reshape(-1)[places] = won[:, part]
    return margins


def _about_surprises(
    flat: Int[np.ndarray, " n"],
    found: Float32[np.ndarray, "n classes"],
    coarse: Float32[np.ndarray, "a b c classes"],
    lattice: _Lattice,
) -> tuple[Int[np.ndarray, " m"], Float32[np.ndarray, "m classes"]]:
    """Ask about every point that touches a surprise, until there is none: what else was asked.

    A surprise is another label than was expected, and not only by what linear logits are off
    everywhere: by more than ``_SURPRISE`` of what is believed of them.

    Args:
        flat, found: the asked ones, and their logits.
        coarse: the logits that the lattice's were expected from.
    """
    from tumortrack.occupancy.kernels import expected_at, neighbours, surprising

    def surprises_among(flat: np.ndarray, found: np.ndarray) -> np.ndarray:
        expected = np.empty_like(found)
        expected_at(coarse, lattice.shape, flat, expected)
        return flat[surprising(expected, found, np.float32(_SURPRISE * lattice.trust.limit))]

    more, logits = [np.zeros(0, np.int64)], [found[:0]]
    surprises = surprises_among(flat, found)
    if not len(surprises):
        return more[0], logits[0]
    known = np.zeros(math.prod(lattice.shape), bool)
    known[flat] = True
    known.reshape(lattice.shape)[::2, ::2, ::2] = True  # the coarse points: settled before
    while len(surprises):
        frontier = neighbours(lattice.shape, surprises, known)
        if not len(frontier):
            break
        more.append(frontier)
        logits.append(lattice.ask(frontier))
        surprises = surprises_among(frontier, logits[-1])
    return np.concatenate(more), np.concatenate(logits)


def leading(rows: Float32[np.ndarray, "n classes"]) -> tuple[np.ndarray, np.ndarray]:
    """The label that leads in every row, and by how much."""
    from tumortrack.occupancy.kernels import best

    labels, leads = np.empty(len(rows), np.uint8), np.empty(len(rows), np.float32)
    best(rows, labels, leads)
    return labels, leads


def _in_slabs(work: Callable[[int, int], object], planes: int) -> list:
    """What ``work(first, last)`` returns for slabs of planes, one a thread."""
    cuts = np.linspace(0, planes, torch.get_num_threads() + 1).astype(int)
    with ThreadPoolExecutor(len(cuts) - 1) as pool:
        return list(pool.map(work, cuts[:-1], cuts[1:]))
