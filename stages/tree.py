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
        count = _split(X, unit, len(centres[-1]), X.shape[1] + 2, new)
        if count == len(centres[-1]):
            break
        centres.append(new[:count])
    return centres


@njit(cache=True)
def _split(X: Array, unit: Ints, cells: int, least: int, out: Array) -> int:  # pragma: no cover - compiled
    """Split every cell; ``unit`` becomes the new assignment, ``out`` the new centres; returns their
    number."""
    N, d = X.shape
    order = np.argsort(unit, kind="mergesort")
    count = start = 0
    for cell in range(cells):
        end = start
        while end < N and unit[order[end]] == cell:
            end += 1
        rows = order[start:end].copy()
        start = end
        mean = np.zeros(d)
        for r in rows:
            mean += X[r]
        mean /= max(len(rows), 1)
        two = np.empty((2, d))
        reach = _principal(X, rows, mean)
        two[0], two[1] = mean - 0.8 * reach, mean + 0.8 * reach
        upper = np.zeros(len(rows), dtype=np.int64)
        for step in range(LLOYD_STEPS + 1):
            share = np.zeros(2)
            sums = np.zeros((2, d))
            for i in range(len(rows)):
                a = b = 0.0
                for j in range(d):
                    a += (X[rows[i], j] - two[0, j]) ** 2
                    b += (X[rows[i], j] - two[1, j]) ** 2
                upper[i] = b < a
                share[upper[i]] += 1
                sums[upper[i]] += X[rows[i]]
            if min(share[0], share[1]) < least or step == LLOYD_STEPS:
                break
            two[0], two[1] = sums[0] / share[0], sums[1] / share[1]
        if min(share[0], share[1]) < least:
            out[count] = mean
            for r in rows:
                unit[r] = count
            count += 1
            continue
        for side in range(2):
            out[count + side] = sums[side] / share[side]
        for i in range(len(rows)):
            unit[rows[i]] = count + upper[i]
        count += 2
    return count


@njit(cache=True)
def _principal(X: Array, rows: Ints, mean: Array) -> Array:  # pragma: no cover - compiled
    """The first principal axis, as long as the standard deviation along it (power iteration)."""
    d = X.shape[1]
    C = np.zeros((d, d))
    for r in rows:
        for i in range(d):
            for j in range(i + 1):
                C[i, j] += (X[r, i] - mean[i]) * (X[r, j] - mean[j])
    for i in range(d):
        for j in range(i):
            C[j, i] = C[i, j]
    C /= max(len(rows), 1)
    axis = np.zeros(d)
    widest = 0
    for i in range(d):
        if C[i, i] > C[widest, widest]:
            widest = i
    axis[:] = C[widest]
    for _ in range(POWER_STEPS):
        length = np.sqrt((axis**2).sum())
        if length == 0.0:
            return axis
        axis = C @ (axis / length)
    variance = np.sqrt((axis**2).sum())
    axis *= np.sqrt(variance) / max(variance, 1e-300)
    return axis
