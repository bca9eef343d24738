"""Gram: what a region's least squares needs, gathered in one pass over any number of rows.

With a partition that is the same for every gene (:mod:`stages.genes`), every gene's residual sum of squares
is that of a subset of the region's centred Gram matrix ``G_m = sum_t (x_t - mean_m)(x_t - mean_m)'``, x the
candidates and the output. So the data are read once, and what is kept does not depend on how many rows there
are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.lags import Lagged

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ROWS = 8192  # of a block: it fits into the cache
DEPENDENT = 1e-10  # share of a regressor's own square below which the others explain it


@dataclass(frozen=True, eq=False)
class Gram:
    """``G``: centred, shape (K + 1, K + 1, M), the output last, the regions innermost; ``counts``: rows of
    each region, shape (M,)."""

    G: Array
    counts: Array

    def rss(self, columns: Sequence[int]) -> Array:
        """Residual sum of squares of each region's affine model in the candidates ``columns``, shape (M,)."""
        return _rss(self.G, np.asarray(columns, dtype=np.int64))


def gather(lagged: Lagged, centre: Array, scale: Array, nodes: Array) -> Gram:
    """The Gram matrices of the Voronoi cells of ``nodes`` (M, K), for ``(candidates | target - centre) /
    scale``, each of shape (K + 1,)."""
    M, K = nodes.shape
    total = np.zeros((M, K + 2, K + 2))
    back, half = np.ascontiguousarray(nodes.T), 0.5 * (nodes**2).sum(axis=1)
    scaled, sorted_ = np.empty((ROWS, K + 2)), np.empty((ROWS, K + 2))
    scaled[:, -1] = 1.0
    ends = np.empty(M + 1, dtype=np.int64)
    for block in lagged.blocks(ROWS):
        n = len(block)
        _standardise(block, centre, 1.0 / scale, scaled)
        near = scaled[:n, :K] @ back if M > 1 else np.zeros((n, 1))
        _sort(scaled[:n], near, half, sorted_, ends)
        for m in range(M):
            part = sorted_[ends[m] : ends[m + 1]]
            total[m] += part.T @ part
    counts = total[:, -1, -1].copy()
    sums = total[:, :-1, -1]
    G = total[:, :-1, :-1] - sums[:, :, None] * sums[:, None, :] / np.maximum(counts, 1.0)[:, None, None]
    return Gram(np.ascontiguousarray(G.transpose(1, 2, 0)), counts)


def of_regions(rows: Array, unit: Ints, regions: int) -> Gram:
    """The Gram matrices of ``rows`` in memory, shape (N, K + 1), by their region, shape (N,)."""
    G = np.empty((regions, rows.shape[1], rows.shape[1]))
    for m in range(regions):
        part = rows[unit == m]
        part = part - part.mean(axis=0) if len(part) else part
        G[m] = part.T @ part
    counts = np.bincount(unit, minlength=regions).astype(float)
    return Gram(np.ascontiguousarray(G.transpose(1, 2, 0)), counts)


@njit(cache=True)
def _standardise(
    block: Array, centre: Array, factor: Array, out: Array
) -> None:  # pragma: no cover - compiled
    for r in range(block.shape[0]):
        for c in range(block.shape[1]):
            out[r, c] = (block[r, c] - centre[c]) * factor[c]


@njit(cache=True)
def _sort(
    rows: Array, near: Array, half: Array, out: Array, ends: Ints
) -> None:  # pragma: no cover - compiled
    """The rows in order of their best matching unit (4.8); ``ends[m]`` is where region m begins."""
    n, M = near.shape
    unit = np.empty(n, dtype=np.int64)
    ends[:] = 0
    for r in range(n):
        best, at = np.inf, 0
        for m in range(M):
            d = half[m] - near[r, m]
            if d < best:
                best, at = d, m
        unit[r] = at
        ends[at + 1] += 1
    for m in range(M):
        ends[m + 1] += ends[m]
    at_ = ends[:-1].copy()
    for r in range(n):
        k = at_[unit[r]]
        at_[unit[r]] += 1
        for c in range(rows.shape[1]):
            out[k, c] = rows[r, c]


@njit(cache=True)
def _rss(G: Array, columns: Ints) -> Array:  # pragma: no cover - compiled
    """Cholesky of each region's (columns, output) submatrix: what is left of the output's own square."""
    k, y, M = len(columns), G.shape[0] - 1, G.shape[2]
    out = np.empty(M)
    L = np.zeros((k, k + 1))
    for m in range(M):
        left = G[y, y, m]
        for d in range(k):
            p = columns[d]
            pivot = G[p, p, m]
            for i in range(d):
                pivot -= L[i, d] ** 2
            if pivot <= DEPENDENT * G[p, p, m]:
                L[d, :] = 0.0
                continue
            for e in range(d + 1, k + 1):
                c = columns[e] if e < k else y
                value = G[p, c, m]
                for i in range(d):
                    value -= L[i, d] * L[i, e]
                L[d, e] = value / np.sqrt(pivot)
            left -= L[d, k] ** 2
        out[m] = max(left, 0.0)
    return out
