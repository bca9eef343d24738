"""A GSMMS at many points in one pass: prediction, doubt, novelty and best matching unit, compiled.

The formulas are those of :mod:`stages.gsmms`. A node whose weight is below ``exp(-REACH)`` of the best
matching unit's counts for nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
REACH = 20.0  # e^-20 = 2e-9


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
    """``S`` (N, d), ``nodes`` and ``mean`` (M, d), ``theta`` (M, d + 1), ``root`` (M, d + 1, B), ``whiten``
    (M, d, d); ``width`` 0 for hard regions."""
    N, d = S.shape
    M, B = len(nodes), root.shape[2]
    prediction, doubt, novelty = np.full(N, np.nan), np.full(N, np.nan), np.full(N, np.nan)
    unit = np.full(N, np.int32(-1))
    square, off = np.empty(M), np.empty(B)
    for i in range(N):
        s = S[i]
        known = True
        for j in range(d):
            known = known and np.isfinite(s[j])
        if not known:
            continue
        best = 0
        for m in range(M):
            square[m] = 0.0
            for j in range(d):
                square[m] += (s[j] - nodes[m, j]) ** 2
            if square[m] < square[best]:
                best = m
        y, total = 0.0, 0.0
        for b in range(B):
            off[b] = 0.0
        for m in range(M):
            weight = 1.0
            if m != best:
                if width == 0.0 or square[m] - square[best] > 2.0 * REACH * width * width:
                    continue
                weight = np.exp((square[best] - square[m]) / (2.0 * width * width))
            total += weight
            for k in range(d + 1):
                x = weight * s[k - 1] if k > 0 else weight
                y += x * theta[m, k]
                for b in range(B):
                    off[b] += x * root[m, k, b]
        variance = 0.0
        for b in range(B):
            variance += off[b] * off[b]
        away = 0.0
        for j in range(d):
            along = 0.0
            for k in range(d):
                along += whiten[best, j, k] * (s[k] - mean[best, k])
            away += along * along
        prediction[i], doubt[i] = y / total, np.sqrt(variance) / total
        novelty[i], unit[i] = np.sqrt(away) / reach, best
    return prediction, doubt, novelty, unit
