"""Sensitivities: the one pass over a window that a step of the innovations fit needs, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Unrolled = tuple[int, ...]
CHUNK = 256  # samples whose columns are kept at once


@njit(cache=True, fastmath={"reassoc", "contract"})
def _add_products(columns: Array, rows: int, G: Array) -> None:  # pragma: no cover - compiled
    """Add the products of the first ``rows`` of the columns (width, rows) to the lower half of G, in
    place."""
    for i in range(len(G)):
        for j in range(i + 1):
            total = 0.0
            for t in range(rows):
                total += columns[i, t] * columns[j, t]
            G[i, j] += total


@njit(cache=True, fastmath={"reassoc", "contract"})
def gram(
    order: Unrolled,
    lags: Unrolled,
    zeros: Unrolled,
    noise: Unrolled,
    drifts: Unrolled,
    u: Array,
    y: Array,
    Ad: Array,
    Bd: Array,
    w: Array,
    scale: Array,
    drifting: NDArray[np.int64],
    phi: float,
    alpha: Array,
    gamma: Array,
) -> tuple[Array, Array]:  # pragma: no cover - compiled
    """``V' V`` of the whitened columns V over a window, shape (width, width).

    Columns: ``(S - 1) y`` with S the sensor without its gain, sensitivities of the output to ln b, ln a_1 ...
    ln a_n, z_1 ... z_m; ``tau s S y`` where the sensor has two lags; those of the innovations to the sensor's
    coefficients of alpha (s) and to gamma (M); responses to the initial states (n + s), to drift of the
    output's gain, to drifts of b (0) or a_i (i); and the innovations, ``(1 + alpha_1 / q + ...) / (1 +
    gamma_1 / q + ...)`` of what the model leaves of y. Without colour phi is 0, and alpha the sensor's alone.

    States: plant (n), sensor (s: y, tau y'), sensor again, plant again, and a sensor for each of the plant's
    first m derivatives; the copies make the sensitivities, as ``dy / d a_i = -s^(n-i) y / A(s)``, and
    ``dy / d z_i`` is the sensor's reading of the plant's i-th derivative. ``Ad`` and ``Bd`` advance them.

    ``order``, ``lags``, ``zeros``, ``noise``, ``drifts``: tuples whose lengths are the numbers n of plant
    coefficients, s of the sensor's lags, m of zeros, M of gamma and D of drifts. Lengths are part of the
    compiled signature, so the loops are unrolled by them; of a closure over them numba's cache mixes up one
    with another."""
    n, s, m, M, D = len(order), len(lags), len(zeros), len(noise), len(drifts)
    again, last, S = n + s, 2 * (n + s) - 1, 2 * (n + s) + s * m
    pole = n + 1 + m + s
    first_x0 = pole + s + M
    first_drift = first_x0 + n + s
    width = first_drift + D + 2
    e, N = width - 1, u.size
    G, columns = np.zeros((width, width)), np.empty((width, CHUNK))
    x, new = np.zeros(S), np.empty(S)
    x[:again] = w[:again]
    gain_drift, input_drift = w[again], w[again + 1]
    free, free_new = np.zeros(again), np.empty(again)
    free[n] = 1.0
    d, d_new = np.zeros((D, again)), np.empty(again)
    raw, new_white = np.zeros(width), np.zeros(width)
    before, white = np.zeros((M, width)), np.zeros((M, width))
    for t in range(N):
        when = (t - 0.5 * (N - 1)) / N
        level = 1.0 + gain_drift * when
        raw[0], raw[1] = level * (x[again] - x[n]), level * x[n]
        for i in range(n):
            raw[2 + i] = -level * scale[i] * x[last - i]
        for i in range(m):
            raw[2 + n + i] = level * x[last + 1 + s * i]
        if s > 1:
            raw[2 + n + m] = level * x[again + 1]
        for i in range(again):
            raw[first_x0 + i] = level * free[i]
        raw[first_drift] = when * x[n]
        for k in range(D):
            raw[first_drift + 1 + k] = level * d[k, n]
        raw[e] = y[t] - level * x[n]
        for i in range(width):
            total = raw[i]
            for k in range(M):
                total += alpha[k] * before[k, i] - gamma[k] * white[k, i]
            new_white[i] = total
        # alpha and gamma act on the whitening filter's own signals
        for k in range(s):
            new_white[pole + k] -= before[k, e]
            if s < M:
                new_white[pole + k] += phi * before[k + 1, e]
        for k in range(M):
            new_white[pole + s + k] += white[k, e]
        for i in range(width):
            for k in range(M - 1, 0, -1):
                before[k, i], white[k, i] = before[k - 1, i], white[k - 1, i]
            before[0, i], white[0, i] = raw[i], new_white[i]
            columns[i, t % CHUNK] = new_white[i]
        if t % CHUNK == CHUNK - 1 or t == N - 1:
            _add_products(columns, t % CHUNK + 1, G)
        moving = (1.0 + input_drift * when) * u[t]
        for i in range(S):
            total = Bd[i] * moving
            for j in range(S):
                total += Ad[i, j] * x[j]
            new[i] = total
        for k in range(D):
            i = drifting[k] - 1
            moved = u[t] if i < 0 else -0.5 * scale[i] * (x[n - 1 - i] + new[n - 1 - i])
            for row in range(again):
                total = Bd[row] * moved * when
                for j in range(again):
                    total += Ad[row, j] * d[k, j]
                d_new[row] = total
            for row in range(again):
                d[k, row] = d_new[row]
        for i in range(S):
            x[i] = new[i]
        for j in range(again):
            total = 0.0
            for i in range(again):
                total += free[i] * Ad[i, j]
            free_new[j] = total
        for j in range(again):
            free[j] = free_new[j]
    for i in range(width):
        G[:i, i] = G[i, :i]
    return G, x[:again].copy()
