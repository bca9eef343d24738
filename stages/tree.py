"""Tree: nested centres of a cloud of points, 1, 2, 4 ... of them, without random numbers.

Every cell is split in two: centres 0.8 standard deviations out on either side along its first principal
axis, then Lloyd steps within the cell. So the centres of a level lie inside the cells of the level before,
and levels can be compared.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ROWS = 2000  # of which the centres are made
LLOYD_STEPS = 3
POWER_STEPS = 20


def nested_centres(X: Array, levels: int) -> list[Array]:
    """Centres of each level, shapes (1, d), (2, d), (4, d) ...; fewer where cells are too small to split.

    >>> [c.shape[0] for c in nested_centres(np.linspace(0, 1, 100)[:, None], 3)]
    [1, 2, 4, 8]
    """
    X = np.ascontiguousarray(X[:: -(-len(X) // ROWS)])
    unit = np.zeros(len(X), dtype=np.int64)
    centres = [X.mean(axis=0, keepdims=True)]
    for _ in range(levels):
        new = np.empty((2 * len(centres[-1]), X.shape[1]))
        order = np.argsort(unit, kind="stable")
        count = _split(X, unit, order, len(centres[-1]), X.shape[1] + 2, new)
        if count == len(centres[-1]):
            break
        centres.append(new[:count])
    return centres


@njit(cache=True)
def _split(
    X: Array, unit: Ints, order: Ints, cells: int, least: int, out: Array
) -> int:  # pragma: no cover - compiled
    """Split every cell, whose rows follow one another in ``order``; ``unit`` becomes the new assignment,
    ``out`` the new centres; returns their number. Loops, as whole rows take long to compile."""
    N, d = X.shape
    count = start = 0
    two, sums, share, mean = np.empty((2, d)), np.empty((2, d)), np.empty(2), np.empty(d)
    for cell in range(cells):
        end = start
        while end < N and unit[order[end]] == cell:
            end += 1
        rows = order[start:end]
        start = end
        mean[:] = 0.0
        for r in rows:
            for j in range(d):
                mean[j] += X[r, j]
        for j in range(d):
            mean[j] /= max(len(rows), 1)
        reach = _principal(X, rows, mean)
        for j in range(d):
            two[0, j], two[1, j] = mean[j] - 0.8 * reach[j], mean[j] + 0.8 * reach[j]
        upper = np.zeros(len(rows), dtype=np.int64)
        for step in range(LLOYD_STEPS + 1):
            share[:], sums[:] = 0.0, 0.0
            for i in range(len(rows)):
                a = b = 0.0
                for j in range(d):
                    a += (X[rows[i], j] - two[0, j]) ** 2
                    b += (X[rows[i], j] - two[1, j]) ** 2
                upper[i] = b < a
                share[upper[i]] += 1
                for j in range(d):
                    sums[upper[i], j] += X[rows[i], j]
            if min(share[0], share[1]) < least or step == LLOYD_STEPS:
                break
            for j in range(d):
                two[0, j], two[1, j] = sums[0, j] / share[0], sums[1, j] / share[1]
        if min(share[0], share[1]) < least:
            for j in range(d):
                out[count, j] = mean[j]
            for r in rows:
                unit[r] = count
            count += 1
            continue
        for j in range(d):
            out[count, j], out[count + 1, j] = sums[0, j] / share[0], sums[1, j] / share[1]
        for i in range(len(rows)):
            unit[rows[i]] = count + upper[i]
        count += 2
    return count


@njit(cache=True)
def _principal(X: Array, rows: Ints, mean: Array) -> Array:  # pragma: no cover - compiled
    """The first principal axis, as long as the standard deviation along it (power iteration)."""
    d, widest = X.shape[1], 0
    C, axis, next_ = np.zeros((d, d)), np.zeros(d), np.zeros(d)
    for r in rows:
        for i in range(d):
            for j in range(i + 1):
                C[i, j] += (X[r, i] - mean[i]) * (X[r, j] - mean[j])
    for i in range(d):
        for j in range(i + 1):
            C[i, j] /= max(len(rows), 1)
            C[j, i] = C[i, j]
    for i in range(d):
        if C[i, i] > C[widest, widest]:
            widest = i
    for i in range(d):
        axis[i] = C[widest, i]
    for _ in range(POWER_STEPS):
        length = _length(axis)
        if length == 0.0:
            return axis
        next_[:] = 0.0
        for i in range(d):
            for j in range(d):
                next_[i] += C[i, j] * (axis[j] / length)
        axis, next_ = next_, axis
    variance = _length(axis)
    for i in range(d):
        axis[i] *= np.sqrt(variance) / max(variance, 1e-300)
    return axis


@njit(cache=True)
def _length(x: Array) -> float:  # pragma: no cover - compiled
    square = 0.0
    for i in range(len(x)):
        square += x[i] * x[i]
    return float(np.sqrt(square))
