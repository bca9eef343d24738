"""A GSMMS at many points in one pass: prediction, doubt, novelty and best matching unit, compiled.

The formulas are those of :mod:`stages.gsmms`. Points are taken ``ROWS`` at a time, as their doubts are one
matrix product.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
ROWS = 64


class Evaluation(NamedTuple):
    """At N points: what is predicted, its doubt, the novelty of the point and its region; NaN and -1 where a
    regressor is missing."""

    prediction: Array
    doubt: Array
    novelty: Array
    unit: NDArray[np.int32]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def evaluate(
    S: Array, nodes: Array, width: float, theta: Array, root: Array, mean: Array, whiten: Array, reach: float
) -> tuple[Array, Array, Array, NDArray[np.int32]]:  # pragma: no cover - compiled
    """``S`` (N, d), ``nodes`` and ``mean`` (M, d), ``theta`` (M, d + 1), ``root`` (M (d + 1), B), ``whiten``
    (M, d, d); ``width`` 0 for hard regions."""
    N, d = S.shape
    M = len(nodes)
    prediction, doubt, novelty = np.full(N, np.nan), np.full(N, np.nan), np.full(N, np.nan)
    unit = np.full(N, np.int32(-1))
    weight, blended = np.empty(M), np.zeros((ROWS, M * (d + 1)))  # of each node 1 and s, times its weight
    for start in range(0, N, ROWS):
        here = min(ROWS, N - start)
        for i in range(here):
            s = S[start + i]
            known = True
            for j in range(d):
                known = known and np.isfinite(s[j])
            if not known:
                blended[i] = 0.0
                continue
            best = _weigh(s, nodes, width, weight)
            y, total = 0.0, weight.sum()
            for m in range(M):
                for k in range(d + 1):
                    x = weight[m] / total * (s[k - 1] if k > 0 else 1.0)
                    blended[i, m * (d + 1) + k] = x
                    y += x * theta[m, k]
            away = 0.0
            for j in range(d):
                along = 0.0
                for k in range(d):
                    along += whiten[best, j, k] * (s[k] - mean[best, k])
                away += along * along
            prediction[start + i], unit[start + i] = y, best
            novelty[start + i] = np.sqrt(away) / reach
        off = np.dot(blended, root)
        for i in range(here):
            if unit[start + i] >= 0:
                variance = 0.0
                for b in range(root.shape[1]):
                    variance += off[i, b] * off[i, b]
                doubt[start + i] = np.sqrt(variance)
    return prediction, doubt, novelty, unit


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _weigh(s: Array, nodes: Array, width: float, weight: Array) -> int:  # pragma: no cover - compiled
    """The best matching unit; fills ``weight`` (M,), 1 for it."""
    best = 0
    for m in range(len(nodes)):
        weight[m] = 0.0
        for j in range(len(s)):
            weight[m] += (s[j] - nodes[m, j]) ** 2
        if weight[m] < weight[best]:
            best = m
    least = weight[best]
    for m in range(len(nodes)):
        if m == best:
            weight[m] = 1.0
        else:
            weight[m] = np.exp((least - weight[m]) / (2.0 * width * width)) if width > 0.0 else 0.0
    return best
