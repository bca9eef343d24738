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


@njit(cache=True)
def gram(
    order: Unrolled,
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
    a: float,
    phi: float,
    gamma: Array,
) -> tuple[Array, Array]:  # pragma: no cover - compiled
    """``V' V`` of the whitened columns V over a window, shape (width, width).

    Columns: sensitivities of the output to ln tau, ln b, ln a_1 ... ln a_n, z_1 ... z_m, those of the
    innovations to a and gamma, responses to the initial states (n + 1), to drift of the output's gain, to
    drifts of b (0) or a_i (i), and the innovations. States: plant (n), sensor, sensor again, plant again,
    and a sensor for each of the plant's first m derivatives; the copies make the sensitivities, as ``dy / d
    ln tau = y / (tau s + 1) - y``, ``dy / d a_i = -s^(n-i) y / A(s)``, and ``dy / d z_i`` is the sensor's
    reading of the plant's i-th derivative. ``Ad`` and ``Bd`` advance them.

    ``order``, ``zeros``, ``noise``, ``drifts``: tuples whose lengths are the numbers n of plant coefficients,
    m of zeros, M of gamma and D of drifts. Lengths are part of the compiled signature, so the loops are
    unrolled by them; of a closure over n, m, M, D numba's cache mixes up one with another."""
    n, m, M, D = len(order), len(zeros), len(noise), len(drifts)
    last, S, pole = 2 * n + 1, 2 * n + 2 + m, n + 2 + m
    first_x0 = pole + 1 + M
    first_drift = first_x0 + n + 1
    width = first_drift + D + 2
    N = u.size
    G, columns = np.zeros((width, width)), np.empty((width, CHUNK))
    x, new, A, A4 = np.zeros(S), np.empty(S), Ad.T.copy(), Ad[: n + 1, : n + 1].T.copy()
    x[: n + 1] = w[: n + 1]
    gain_drift, input_drift = w[n + 1], w[n + 2]
    free, free_new = np.zeros(n + 1), np.empty(n + 1)
    free[n] = 1.0
    d, d_new = np.zeros((D, n + 1)), np.empty(n + 1)
    raw, white, new_white = np.zeros(width), np.zeros(width), np.zeros(width)
    white2, before, before2 = np.zeros(width), np.zeros(width), np.zeros(width)
    c1, c2 = gamma[0], gamma[M - 1] if M > 1 else 0.0
    for t in range(N):
        when = (t - 0.5 * (N - 1)) / N
        level = 1.0 + gain_drift * when
        raw[0], raw[1] = level * (x[n + 1] - x[n]), level * x[n]
        for i in range(n):
            raw[2 + i] = -level * scale[i] * x[last - i]
        for i in range(m):
            raw[2 + n + i] = level * x[last + 1 + i]
        for i in range(n + 1):
            raw[first_x0 + i] = level * free[i]
        raw[first_drift] = when * x[n]
        for k in range(D):
            raw[first_drift + 1 + k] = level * d[k, n]
        raw[width - 1] = y[t] - level * x[n]
        # whitened by (q - a) (q - phi) / C; a and gamma act on that filter's own signals
        for i in range(width):
            new_white[i] = raw[i] - (a + phi) * before[i] + a * phi * before2[i]
        new_white[pole] = before[width - 1] - phi * before2[width - 1]
        new_white[pole + 1] = white[width - 1]
        if M > 1:
            new_white[pole + M] = white2[width - 1]
        for i in range(width):
            new_white[i] -= c1 * white[i] + c2 * white2[i]
            white2[i], white[i] = white[i], new_white[i]
            before2[i], before[i] = before[i], raw[i]
        columns[:, t % CHUNK] = white
        if t % CHUNK == CHUNK - 1 or t == N - 1:
            _add_products(columns, t % CHUNK + 1, G)
        for i in range(S):
            new[i] = Bd[i] * (1.0 + input_drift * when) * u[t]
        for j in range(S):
            for i in range(S):
                new[i] += A[j, i] * x[j]
        for k in range(D):
            i = drifting[k] - 1
            moved = u[t] if i < 0 else -0.5 * scale[i] * (x[n - 1 - i] + new[n - 1 - i])
            for row in range(n + 1):
                d_new[row] = Bd[row] * moved * when
            for j in range(n + 1):
                for row in range(n + 1):
                    d_new[row] += A4[j, row] * d[k, j]
            d[k] = d_new
        x[:] = new
        free_new[:] = 0.0
        for i in range(n + 1):
            for j in range(n + 1):
                free_new[j] += free[i] * Ad[i, j]
        free[:] = free_new
    for i in range(width):
        G[:i, i] = G[i, :i]
    return G, x[: n + 1].copy()
