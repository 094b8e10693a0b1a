"""Compiled kernels on lattices of logits: refinement, filling, trilinear interpolation."""

from __future__ import annotations

import numpy as np

from tumortrack.core.compiled import njit


@njit(nogil=True, inline="always")
def _linear(coarse, low, high, n):  # type: ignore[no-untyped-def]
    """Logit ``n`` halfway between two coarse points; along an axis both may be the same."""
    i, j, k = low
    i1, j1, k1 = high
    near = coarse[i, j, k, n] + coarse[i, j, k1, n]
    near += coarse[i, j1, k, n] + coarse[i, j1, k1, n]
    far = coarse[i1, j, k, n] + coarse[i1, j, k1, n]
    far += coarse[i1, j1, k, n] + coarse[i1, j1, k1, n]
    return np.float32(0.125) * (near + far)


@njit(nogil=True)
def halved(coarse, fine, first, last):  # type: ignore[no-untyped-def]
    """Logits at half the step, linear between the coarse ones (a, b, c, classes), into planes
    ``first`` to ``last`` of ``fine`` (2a - 1, 2b - 1, 2c - 1, classes), float32."""
    for i in range(first, last):
        for j in range(fine.shape[1]):
            for k in range(fine.shape[2]):
                low = i // 2, j // 2, k // 2
                high = (i + 1) // 2, (j + 1) // 2, (k + 1) // 2
                for n in range(fine.shape[3]):
                    fine[i, j, k, n] = _linear(coarse, low, high, n)


@njit(nogil=True)
def leading(logits):  # type: ignore[no-untyped-def]
    """The label of the largest logit in every row (n, classes), and its lead over the second."""
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
def mispredicted(coarse, shape, flat, logits, limit):  # type: ignore[no-untyped-def]
    """Which points (n,) of the lattice of half the step, flat indices, have another label than
    linear interpolation predicts, where the prediction of the two labels' difference is off by more
    than the limit. ``logits``: those queried at the points (n, classes)."""
    wrong = np.zeros(len(flat), np.bool_)
    expected = np.empty(coarse.shape[3], np.float32)
    for m in range(len(flat)):
        i, rest = divmod(flat[m], shape[1] * shape[2])
        j, k = divmod(rest, shape[2])
        low, high = (i // 2, j // 2, k // 2), ((i + 1) // 2, (j + 1) // 2, (k + 1) // 2)
        predicted, label = 0, 0
        for n in range(len(expected)):
            expected[n] = _linear(coarse, low, high, n)
            if expected[n] > expected[predicted]:
                predicted = n
            if logits[m, n] > logits[m, label]:
                label = n
        before = expected[predicted] - expected[label]
        now = logits[m, label] - logits[m, predicted]
        wrong[m] = predicted != label and before + now > limit
    return flat[wrong]


@njit(nogil=True)
def fill_margins(labels, inside, outside, margins, first, last):  # type: ignore[no-untyped-def]
    """Set the ``margins`` (parts, i, j, k) in planes ``first`` to ``last`` to one of two values
    (half precision, as integers) by the labels (i, j, k). All parts are inside the first one."""
    for i in range(first, last):
        for j in range(labels.shape[1]):
            row = labels[i, j]
            for part in range(len(margins)):
                out = margins[part, i, j]
                for k in range(len(row)):
                    within = row[k] > 0 if part == 0 else row[k] == part + 1
                    out[k] = inside if within else outside


@njit(nogil=True, inline="always")
def _certain_row(certain, i, j, labels):  # type: ignore[no-untyped-def]
    """The label on which the eight corners of each cell of a row agree, 255 if they do not."""
    i1, j1 = min(i + 1, certain.shape[0] - 1), min(j + 1, certain.shape[1] - 1)
    for k in range(certain.shape[2]):
        label = certain[i, j, k]
        same = label == certain[i, j1, k] == certain[i1, j, k] == certain[i1, j1, k]
        labels[k] = label if same else 255
    for k in range(certain.shape[2] - 1):
        if labels[k] != labels[k + 1]:
            labels[k] = 255


@njit(nogil=True)
def fill_cells(coarse, labels, certain, fine, first, last):  # type: ignore[no-untyped-def]
    """Fill the voxels ``fine`` (i, j, k), of half the step, from the lattice ``coarse`` (a, b, c,
    classes), its ``labels`` (a, b, c) and the ``certain`` ones, 255 elsewhere; cell by cell, coarse
    planes ``first`` to ``last``. A cell whose corners have the same certain label is filled with
    it: by linear interpolation none of its voxels is less certain. The voxels of all other cells
    are returned: flat indices (n,), linear logits (n, classes), and whether they lie between coarse
    points."""
    _, n_j, n_k = fine.shape
    agreed = np.empty(coarse.shape[2], np.uint8)
    cells = 0
    for i in range(first, last):
        for j in range(coarse.shape[1]):
            _certain_row(certain, i, j, agreed)
            cells += (agreed == 255).sum()
    flat = np.empty(8 * cells, np.int64)
    expected = np.empty((8 * cells, coarse.shape[3]), np.float32)
    between = np.empty(8 * cells, np.bool_)
    count = 0
    for i in range(first, last):
        for j in range(coarse.shape[1]):
            _certain_row(certain, i, j, agreed)
            for k in range(coarse.shape[2]):
                for a in range(2 * i, min(2 * i + 2, fine.shape[0])):
                    for b in range(2 * j, min(2 * j + 2, n_j)):
                        for c in range(2 * k, min(2 * k + 2, n_k)):
                            fine[a, b, c] = labels[i, j, k]
                            if agreed[k] != 255:
                                continue
                            high = (a + 1) // 2, (b + 1) // 2, (c + 1) // 2
                            for n in range(coarse.shape[3]):
                                expected[count, n] = _linear(coarse, (i, j, k), high, n)
                            flat[count] = (a * n_j + b) * n_k + c
                            between[count] = a % 2 + b % 2 + c % 2 > 0
                            count += 1
    return flat[:count].copy(), expected[:count].copy(), between[:count].copy()


@njit(nogil=True)
def neighbours(shape, frontier, known):  # type: ignore[no-untyped-def]
    """The voxels that touch these and are not known yet, as flat indices. They are marked as known,
    since the caller queries them next."""
    n_i, n_j, n_k = shape
    flat = np.empty(max(26 * len(frontier), 1), np.int64)
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
                        flat[count] = at
                        count += 1
    return flat[:count].copy()


@njit(nogil=True, inline="always")
def _cell(at, size):  # type: ignore[no-untyped-def]
    """The cell of a coordinate along one axis, and the position within it, 0 to 1."""
    at = min(max(at, np.float32(0)), np.float32(size - 1))
    low = min(int(at), size - 2)
    return low, at - np.float32(low)


@njit(nogil=True)
def trilinear(values, place):  # type: ignore[no-untyped-def]
    """Trilinear interpolation of a lattice (a, b, c, n) at places (m, 3), in its steps: (m, n);
    outside the value at the nearest border."""
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
