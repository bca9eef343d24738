"""A GSMMS at many points in one pass: prediction, doubt, novelty and best matching unit, compiled.

The formulas are those of :mod:`stages.gsmms`. Points are taken ``ROWS`` at a time: loops run along them, so
that several are computed at once, and predictions and doubts are one matrix product.
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
    S: Array, nodes: Array, width: float, linear: Array, mean: Array, whiten: Array, reach: float
) -> tuple[Array, Array, Array, NDArray[np.int32]]:  # pragma: no cover - compiled
    """``S`` (N, d), ``nodes`` and ``mean`` (M, d), ``whiten`` (M, d, d); ``linear`` (B + 1, M (d + 1)): what
    makes deviations and at last the prediction of the blended regressors; ``width`` 0 for hard regions."""
    N, d = S.shape
    B = len(linear) - 1
    prediction, doubt, novelty = np.full(N, np.nan), np.full(N, np.nan), np.full(N, np.nan)
    unit = np.full(N, np.int32(-1))
    s, weight, best = np.zeros((d, ROWS)), np.empty((len(nodes), ROWS)), np.empty(ROWS, dtype=np.int32)
    variance = np.empty(ROWS)
    blended = np.empty((len(nodes) * (d + 1), ROWS))  # of each node 1 and s, times its weight
    for start in range(0, N, ROWS):
        here = min(ROWS, N - start)
        for i in range(here):
            for j in range(d):
                s[j, i] = S[start + i, j]
        _weigh(s, nodes, width, weight, best)
        for m in range(len(nodes)):
            for i in range(ROWS):
                blended[m * (d + 1), i] = weight[m, i]
            for j in range(d):
                for i in range(ROWS):
                    blended[m * (d + 1) + 1 + j, i] = weight[m, i] * s[j, i]
        found = np.dot(linear, blended)
        variance[:] = 0.0
        for b in range(B):
            for i in range(ROWS):
                variance[i] += found[b, i] * found[b, i]
        for i in range(here):
            away = _away(s, i, mean, whiten, best[i])
            if np.isfinite(away):  # else a regressor is missing
                prediction[start + i], doubt[start + i] = found[B, i], np.sqrt(variance[i])
                novelty[start + i], unit[start + i] = away / reach, best[i]
    return prediction, doubt, novelty, unit


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _weigh(
    s: Array, nodes: Array, width: float, weight: Array, best: NDArray[np.int32]
) -> None:  # pragma: no cover - compiled
    """Fill ``best`` (rows,), the best matching unit of ``s`` (d, rows), and the shares ``weight`` (M,
    rows)."""
    rows = weight.shape[1]
    least, total = np.full(rows, np.inf), np.zeros(rows)
    best[:] = 0
    for m in range(len(nodes)):
        for i in range(rows):
            weight[m, i] = (s[0, i] - nodes[m, 0]) ** 2
        for j in range(1, len(s)):
            for i in range(rows):
                weight[m, i] += (s[j, i] - nodes[m, j]) ** 2
        for i in range(rows):
            nearer = weight[m, i] < least[i]
            best[i] = m if nearer else best[i]
            least[i] = weight[m, i] if nearer else least[i]
    if width == 0.0:
        for m in range(len(nodes)):
            for i in range(rows):
                weight[m, i] = 1.0 if m == best[i] else 0.0
        return
    scale = 0.5 / (width * width)
    for m in range(len(nodes)):
        for i in range(rows):
            weight[m, i] = _faded((least[i] - weight[m, i]) * scale)
            total[i] += weight[m, i]
    for i in range(rows):
        total[i] = 1.0 / total[i]
    for m in range(len(nodes)):
        for i in range(rows):
            weight[m, i] *= total[i]


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _away(s: Array, i: int, mean: Array, whiten: Array, m: int) -> float:  # pragma: no cover - compiled
    """The whitened distance of point ``i`` of ``s`` (d, rows) from region ``m``."""
    square = 0.0
    for j in range(len(s)):
        along = 0.0
        for k in range(len(s)):
            along += whiten[m, j, k] * (s[k, i] - mean[m, k])
        square += along * along
    return float(np.sqrt(square))


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _faded(x: float) -> float:  # pragma: no cover - compiled
    """exp(x) for x <= 0 as ``exp(x / 256)^256``, of which Taylor's series needs six terms; no branches, as in
    a library's, keep the compiler from taking several at a time. Relative error 1e-11 at -10, no less than
    e^-40."""
    x = max(x, -40.0) / 256.0
    y = 1.0 + x * (1.0 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x * (1 / 720))))))
    for _ in range(8):
        y *= y
    return y
