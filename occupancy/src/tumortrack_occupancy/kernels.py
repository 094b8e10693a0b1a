"""Compiled kernels on lattices of logits: refinement, filling, trilinear interpolation."""

from __future__ import annotations

import numpy as np

from tumortrack.core.compiled import njit


@njit(nogil=True, inline="always")
def _linear(coarse, low, high, n):  # type: ignore[no-untyped-def]
    """Logit ``n`` in the middle of two coarse points, equal along axes where it lies on one."""
    i, j, k = low
    i1, j1, k1 = high
    near = coarse[i, j, k, n] + coarse[i, j, k1, n]
    near += coarse[i, j1, k, n] + coarse[i, j1, k1, n]
    far = coarse[i1, j, k, n] + coarse[i1, j, k1, n]
    far += coarse[i1, j1, k, n] + coarse[i1, j1, k1, n]
    return np.float32(0.125) * (near + far)


@njit(nogil=True)
def halved(coarse, fine, first, last):  # type: ignore[no-untyped-def]
    """Logits at half the step, linear between the coarse ones (a, b, c, classes), into ``fine``
    (2a - 1, 2b - 1, 2c - 1, classes), float32; planes ``first`` to ``last``."""
    for i in range(first, last):
        for j in range(fine.shape[1]):
            for k in range(fine.shape[2]):
                low = i // 2, j // 2, k // 2
                high = (i + 1) // 2, (j + 1) // 2, (k + 1) // 2
                for n in range(fine.shape[3]):
                    fine[i, j, k, n] = _linear(coarse, low, high, n)


@njit(nogil=True)
def leading(logits):  # type: ignore[no-untyped-def]
    """The label that leads in every row (n, classes), and by how much."""
    labels, leads = np.empty(len(logits), np.uint8), np.empty(len(logits), np.float32)
    for row in range(len(logits)):
        first, second, label = np.float32(-np.inf), np.float32(-np.inf), 0
        for n in range(logits.shape[1]):
            value = logits[row, n]
            if value > first:
                first, second, label = value, first, n
            elif value > second:
                second = value
        labels[row] = label
        leads[row] = first - second
    return labels, leads


@njit(nogil=True)
def surprising(coarse, shape, flat, found, limit):  # type: ignore[no-untyped-def]
    """Which points (n,) of the lattice of half the step, flat indices, have another label than
    linear logits let expect, the difference of the two labels' logits being off by more than the
    limit. ``found``: their logits (n, classes)."""
    surprises = np.zeros(len(flat), np.bool_)
    expected = np.empty(coarse.shape[3], np.float32)
    for m in range(len(flat)):
        i, rest = divmod(flat[m], shape[1] * shape[2])
        j, k = divmod(rest, shape[2])
        low, high = (i // 2, j // 2, k // 2), ((i + 1) // 2, (j + 1) // 2, (k + 1) // 2)
        thought, label = 0, 0
        for n in range(len(expected)):
            expected[n] = _linear(coarse, low, high, n)
            if expected[n] > expected[thought]:
                thought = n
            if found[m, n] > found[m, label]:
                label = n
        before = expected[thought] - expected[label]
        now = found[m, label] - found[m, thought]
        surprises[m] = thought != label and before + now > limit
    return flat[surprises]


@njit(nogil=True)
def spread(labels, inside, outside, margins, first, last):  # type: ignore[no-untyped-def]
    """Per part one of two values (bits of half precision) into ``margins`` (parts, i, j, k) by the
    labels (i, j, k); the first part is inside wherever there is one. Planes first to last."""
    for i in range(first, last):
        for j in range(labels.shape[1]):
            row = labels[i, j]
            for part in range(len(margins)):
                out = margins[part, i, j]
                for k in range(len(row)):
                    mine = row[k] > 0 if part == 0 else row[k] == part + 1
                    out[k] = inside if mine else outside


@njit(nogil=True, inline="always")
def _confident_row(plain, i, j, labels):  # type: ignore[no-untyped-def]
    """The label on which the eight corners of each cell agree, 255 where there is none."""
    i1, j1 = min(i + 1, plain.shape[0] - 1), min(j + 1, plain.shape[1] - 1)
    for k in range(plain.shape[2]):
        one = plain[i, j, k]
        same = one == plain[i, j1, k] and one == plain[i1, j, k] and one == plain[i1, j1, k]
        labels[k] = one if same else 255
    for k in range(plain.shape[2] - 1):
        if labels[k] != labels[k + 1]:
            labels[k] = 255


@njit(nogil=True)
def filled(coarse, labels, plain, fine, first, last):  # type: ignore[no-untyped-def]
    """The voxels between the points of the last lattice but one, cell by cell, from coarse plane
    ``first`` to ``last``. A cell whose corners agree and all lead by the limit holds no voxel that
    leads by less: it is filled with their label in ``fine`` (i, j, k). All other cells' voxels are
    listed: flat indices (n,), linear logits (n, classes), and whether they lie between coarse
    points. ``coarse`` (a, b, c, classes) has these ``labels``; ``plain``: those that lead by the
    limit, 255 for the others."""
    _, n_j, n_k = fine.shape
    confident = np.empty(coarse.shape[2], np.uint8)
    cells = 0
    for i in range(first, last):
        for j in range(coarse.shape[1]):
            _confident_row(plain, i, j, confident)
            cells += (confident == 255).sum()
    listed = np.empty(8 * cells, np.int64)
    expected = np.empty((8 * cells, coarse.shape[3]), np.float32)
    between = np.empty(8 * cells, np.bool_)
    count = 0
    for i in range(first, last):
        for j in range(coarse.shape[1]):
            _confident_row(plain, i, j, confident)
            for k in range(coarse.shape[2]):
                for a in range(2 * i, min(2 * i + 2, fine.shape[0])):
                    for b in range(2 * j, min(2 * j + 2, n_j)):
                        for c in range(2 * k, min(2 * k + 2, n_k)):
                            fine[a, b, c] = labels[i, j, k]
                            if confident[k] != 255:
                                continue
                            high = (a + 1) // 2, (b + 1) // 2, (c + 1) // 2
                            for n in range(coarse.shape[3]):
                                expected[count, n] = _linear(coarse, (i, j, k), high, n)
                            listed[count] = (a * n_j + b) * n_k + c
                            between[count] = a % 2 + b % 2 + c % 2 > 0
                            count += 1
    return listed[:count].copy(), expected[:count].copy(), between[:count].copy()


@njit(nogil=True)
def neighbours(shape, frontier, known):  # type: ignore[no-untyped-def]
    """The voxels that touch these and are not known yet: flat indices. They are marked as known,
    since the caller queries them next."""
    n_i, n_j, n_k = shape
    found = np.empty(max(26 * len(frontier), 1), np.int64)
    count = 0
    for n in range(len(frontier)):
        i, rest = divmod(frontier[n], n_j * n_k)
        j, k = divmod(rest, n_k)
        for a in range(max(i - 1, 0), min(i + 2, n_i)):
            for b in range(max(j - 1, 0), min(j + 2, n_j)):
                for c in range(max(k - 1, 0), min(k + 2, n_k)):
                    at = (a * n_j + b) * n_k + c
                    if not known[at]:
                        known[at] = True
                        found[count] = at
                        count += 1
    return found[:count].copy()


@njit(nogil=True, inline="always")
def _cell(at, size):  # type: ignore[no-untyped-def]
    """The cell of a coordinate along one axis, and the fraction of the cell up to it."""
    at = min(max(at, np.float32(0)), np.float32(size - 1))
    low = min(int(at), size - 2)
    return low, at - np.float32(low)


@njit(nogil=True)
def between(values, place):  # type: ignore[no-untyped-def]
    """Trilinear values (m, n) of a lattice (a, b, c, n) at places (m, 3), in its steps; outside
    those of the nearest border."""
    out = np.empty((len(place), values.shape[3]), np.float32)
    for m in range(len(place)):
        i, x = _cell(place[m, 0], values.shape[0])
        j, y = _cell(place[m, 1], values.shape[1])
        k, z = _cell(place[m, 2], values.shape[2])
        for n in range(values.shape[3]):
            near = (1 - z) * values[i, j, k, n] + z * values[i, j, k + 1, n]
            right = (1 - z) * values[i, j + 1, k, n] + z * values[i, j + 1, k + 1, n]
            near = (1 - y) * near + y * right
            far = (1 - z) * values[i + 1, j, k, n] + z * values[i + 1, j, k + 1, n]
            right = (1 - z) * values[i + 1, j + 1, k, n] + z * values[i + 1, j + 1, k + 1, n]
            far = (1 - y) * far + y * right
            out[m, n] = (1 - x) * near + x * far
    return out
