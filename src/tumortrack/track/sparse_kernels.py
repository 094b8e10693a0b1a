"""The compiled parts of ``track.sparse``."""

from __future__ import annotations

import numba
import numpy as np

UNKNOWN = 255  # label of a voxel that must be asked


@numba.njit(cache=True, nogil=True)
def refined(coarse, known, fine, fine_known):  # type: ignore[no-untyped-def]
    """Labels at half the distance: between equal ones the same, between others ``UNKNOWN``.

    Args:
        coarse, known: labels (a, b, c), and which of them were asked.
        fine, fine_known: (2a - 1, 2b - 1, 2c - 1); filled.

    Returns:
        Flat indices of the unknown.
    """
    n_i, n_j, n_k = fine.shape
    count = 0
    asked = np.empty(1024, np.int64)
    for i in range(n_i):
        i0, i1 = i // 2, (i + 1) // 2
        for j in range(n_j):
            j0, j1 = j // 2, (j + 1) // 2
            level = i0 == i1 and j0 == j1
            for k in range(n_k):
                k0, k1 = k // 2, (k + 1) // 2
                label = coarse[i0, j0, k0]
                if level and k0 == k1:
                    fine[i, j, k] = label
                    fine_known[i, j, k] = known[i0, j0, k0]
                    continue
                fine_known[i, j, k] = False
                same = (
                    label == coarse[i0, j0, k1]
                    and label == coarse[i0, j1, k0]
                    and label == coarse[i0, j1, k1]
                    and label == coarse[i1, j0, k0]
                    and label == coarse[i1, j0, k1]
                    and label == coarse[i1, j1, k0]
                    and label == coarse[i1, j1, k1]
                )
                if same:
                    fine[i, j, k] = label
                    continue
                fine[i, j, k] = UNKNOWN
                if count == len(asked):
                    longer = np.empty(2 * count, np.int64)
                    longer[:count] = asked
                    asked = longer
                asked[count] = (i * n_j + j) * n_k + k
                count += 1
    return asked[:count].copy()


@numba.njit(cache=True, nogil=True)
def doubtful(labels, known, frontier):  # type: ignore[no-untyped-def]
    """Voxels that were not asked and touch one of these with another label: flat indices.

    They are marked as known, for whoever asks them now.
    """
    n_i, n_j, n_k = labels.shape
    found = np.empty(max(26 * len(frontier), 1), np.int64)
    count = 0
    for n in range(len(frontier)):
        i, rest = divmod(frontier[n], n_j * n_k)
        j, k = divmod(rest, n_k)
        mine = labels[i, j, k]
        for a in range(max(i - 1, 0), min(i + 2, n_i)):
            for b in range(max(j - 1, 0), min(j + 2, n_j)):
                for c in range(max(k - 1, 0), min(k + 2, n_k)):
                    if not known[a, b, c] and labels[a, b, c] != mine:
                        known[a, b, c] = True
                        found[count] = (a * n_j + b) * n_k + c
                        count += 1
    return found[:count].copy()
