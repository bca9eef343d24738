"""Evidence: the likelihood of residuals under a hypothesis, with forgetting and with unknown run offsets.

For a residual e with spread sigma, weights ``w = min(dt, tau_c) / tau_c`` and forgetting ``exp(-age / T)``,
the stage keeps

    A = sum w h h' / sigma^2,   b = sum w h e / sigma^2,   q = sum w [(e / sigma)^2 + 2 ln sigma],

where h are the shapes of what differs from run to run, e.g. h = 1 for a plain offset, each with a coefficient
``c ~ N(0, s^2)``. Integrating c out gives the log-likelihood

    L = -1/2 [q - b' (A + diag(1 / s^2))^-1 b + ln |I + diag(s^2) A|].

Residuals add up. There are at most two shapes for a residual. What a relation is in doubt of (``model_sd``)
is shared by neighbouring samples too, so its remembered mean square ``D / A11`` is added to the first
``s^2``.

A spike must not decide. Before it is added, an e beyond ``clip`` spreads is held within as many of its own
mean over a short memory: clipping e itself would hide the scatter of a large offset, and make wrong
hypotheses look better than right ones.

All compiled code is in this one file: the compiler's cache does not see changes in another.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
SUMS = 7  # A11, A12, A22, b1, b2, q, D


@njit(cache=True)
def tame(e: Array, sigma: Array, S: Array, clip: float) -> Array:  # pragma: no cover - compiled
    """``e`` (points, residuals), where beyond ``clip`` spreads, held within as many of the means that ``S``
    remembers."""
    tamed = e.copy()
    for p in range(e.shape[0]):
        for r in range(e.shape[1]):
            reach = clip * sigma[p, r]
            if S[p, r, 0] > 0 and abs(e[p, r]) > reach:
                mean = S[p, r, 3] / S[p, r, 0]
                tamed[p, r] = min(max(e[p, r], mean - reach), mean + reach)
    return tamed


@njit(cache=True)
def add_sample(
    S: Array, e: Array, sigma: Array, doubt: Array, shapes: Array, weight: float
) -> None:  # pragma: no cover - compiled
    """Add one row to the sums ``S`` (points, residuals, SUMS) of one memory, in place."""
    for p in range(e.shape[0]):
        for r in range(e.shape[1]):
            x, s = e[p, r], sigma[p, r]
            if np.isnan(x) or np.isnan(s):
                continue
            w = weight / (s * s)
            h1, h2 = shapes[r, 0], shapes[r, 1]
            S[p, r, 0] += w * h1 * h1
            S[p, r, 1] += w * h1 * h2
            S[p, r, 2] += w * h2 * h2
            S[p, r, 3] += w * h1 * x
            S[p, r, 4] += w * h2 * x
            S[p, r, 5] += w * x * x + weight * 2.0 * np.log(s)
            S[p, r, 6] += w * h1 * h1 * doubt[p, r] ** 2


@njit(cache=True)
def log_likelihood(S: Array, sd: Array) -> float:  # pragma: no cover - compiled
    """L of one point: ``S`` (residuals, SUMS), ``sd`` (residuals, 2), a standard deviation 0 where there is
    no shape.

    Written for ``s^2 A``, so that s = 0 needs no inverse.
    """
    total = 0.0
    for r in range(S.shape[0]):
        v1, v2 = sd[r, 0] ** 2, sd[r, 1] ** 2
        if S[r, 0] > 0:
            v1 += S[r, 6] / S[r, 0]
        a11, a12, a22 = 1.0 + v1 * S[r, 0], S[r, 1], 1.0 + v2 * S[r, 2]
        det = a11 * a22 - v1 * v2 * a12 * a12
        b1, b2 = S[r, 3], S[r, 4]
        # b' (A + V^-1)^-1 b = b' V (I + A V)^-1 b for V = diag(v1, v2)
        explained = (v1 * a22 * b1 * b1 - 2.0 * v1 * v2 * a12 * b1 * b2 + v2 * a11 * b2 * b2) / det
        total -= 0.5 * (S[r, 5] - explained + np.log(det))
    return total


@njit(cache=True)
def between(
    x: Array, left: NDArray[np.int64], right: NDArray[np.int64], share: Array
) -> Array:  # pragma: no cover - compiled
    """Rows of ``x`` (points, residuals) interpolated: ``(1 - share) x[left] + share x[right]``."""
    out = np.empty((len(left), x.shape[1]))
    for p in range(len(left)):
        for r in range(x.shape[1]):
            out[p, r] = (1.0 - share[p]) * x[left[p], r] + share[p] * x[right[p], r]
    return out


@njit(cache=True)
def peak(x: Array, L: Array) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Place, height and standard deviation of the maximum of a log-likelihood on an even grid around it.

    The vertex of the parabola through the best point and its neighbours; at the grid's ends, or where that is
    no maximum, the best point with an infinite standard deviation.
    """
    j = 0
    for i in range(len(x)):
        if L[i] > L[j]:
            j = i
    if j == 0 or j == len(x) - 1:
        return x[j], L[j], np.inf
    d1 = (L[j] - L[j - 1]) / (x[j] - x[j - 1])
    d2 = (L[j + 1] - L[j]) / (x[j + 1] - x[j])
    curve = (d2 - d1) / (x[j + 1] - x[j - 1])
    if curve >= 0:
        return x[j], L[j], np.inf
    place = 0.5 * (x[j - 1] + x[j] - d1 / curve)
    height = L[j - 1] + d1 * (place - x[j - 1]) + curve * (place - x[j - 1]) * (place - x[j])
    return place, max(height, L[j]), np.sqrt(-0.5 / curve)


@njit(cache=True)
def evidence_of(
    S: Array, sd: Array, unknown_sd: Array, points: NDArray[np.int64], sizes: Array, prior: Array,
    count: NDArray[np.int64],
) -> tuple[Array, Array, Array]:  # fmt: skip  # pragma: no cover - compiled
    """Evidence of every fault, and last of ``unknown``; sizes and their standard deviations."""
    F, H = points.shape[0], S.shape[0] - 1
    L = np.empty(H)
    for p in range(H):
        L[p] = log_likelihood(S[p], sd)
    healthy, top = 0.0, np.max(L + prior)
    for p in range(H):
        if prior[p] > -np.inf:
            healthy += np.exp(L[p] + prior[p] - top)
    healthy = top + np.log(healthy)
    evidence, size, size_sd = np.empty(F + 1), np.empty(F), np.empty(F)
    for f in range(F):
        x = sizes[f, : count[f]]
        size[f], height, size_sd[f] = peak(x, L[points[f, : count[f]]])
        width = min(1.0, np.sqrt(2.0 * np.pi) * size_sd[f] / (x[-1] - x[0]))
        evidence[f] = height + np.log(width) - healthy
    evidence[F] = log_likelihood(S[H], unknown_sd) - healthy
    return evidence, size, size_sd


@njit(cache=True)
def excess(
    S: Array, sd: Array, points: NDArray[np.int64], sizes: Array, size: float
) -> float:  # pragma: no cover - compiled
    """Log-likelihood of one fault at the size of the grid next to ``size``, over that of the log as it is."""
    near = 0 if points[0] > 0 else 1
    for i in range(len(points)):
        if points[i] > 0 and abs(sizes[i] - size) < abs(sizes[near] - size):
            near = i
    return log_likelihood(S[points[near]], sd) - log_likelihood(S[0], sd)


@njit(cache=True)
def follow(
    dt: Array, active: NDArray[np.bool_], known: Array, e: Array, sigma: Array, doubt: Array, shapes: Array,
    sd: Array, unknown_sd: Array,
    points: NDArray[np.int64], sizes: Array, prior: Array, count: NDArray[np.int64],
    left: NDArray[np.int64], right: NDArray[np.int64], share: Array, memories: Array,
    threshold: Array, numbers: Array, S: Array, clocks: Array, largest: Array,
) -> tuple[Array, NDArray[np.int8], Array, Array, Array, Array]:  # fmt: skip  # pragma: no cover - compiled
    """The recursion over the rows; changes ``S``, ``clocks`` and ``largest`` in place."""
    N, F, T = len(dt), points.shape[0], len(memories) - 1
    correlation, clip, confirm, clear, temper, penalty = numbers
    statistic, detection = np.full(N, -np.inf), np.zeros(N, dtype=np.int8)
    out_evidence, out_p = np.zeros((N, F)), np.zeros((N, F + 1))
    out_size, out_sd = np.zeros((N, F)), np.zeros((N, F))
    row = 0
    for k in range(N):
        weight = min(dt[k], correlation) / correlation
        if active[k]:
            weight *= known[row]
            spread, own = between(sigma[row], left, right, share), between(doubt[row], left, right, share)
            tamed = tame(between(e[row], left, right, share), spread, S[1, :-1], clip)
        for i in range(T + 1):
            S[i] *= np.exp(-dt[k] / memories[i])
            if active[k]:
                add_sample(S[i, :-1], tamed, spread, own, shapes[row], weight)
                add_sample(S[i, -1:], e[row, :1], sigma[row, :1], doubt[row, :1], shapes[row], weight)
        row += active[k]
        best, named, tamed = np.full(F + 1, -np.inf), 0.0, np.empty((0, 0))
        for i in range(T):
            evidence, size, size_sd = evidence_of(S[i], sd, unknown_sd, points, sizes, prior, count)
            if i == 1 and clocks[0] == 1:
                named = excess(S[1], sd, points[int(clocks[2])], sizes[int(clocks[2])], clocks[3])
            for f in range(F):
                largest[i, f] = max(largest[i, f], evidence[f])
                statistic[k] = max(statistic[k], evidence[f] - threshold[i, f])
                if evidence[f] > best[f]:
                    best[f], out_size[k, f], out_sd[k, f] = evidence[f], size[f], size_sd[f]
        if clocks[0] == 0:
            clocks[1] = clocks[1] + dt[k] if statistic[k] > 0 else 0.0
            if clocks[1] >= confirm:
                clocks[:] = 0.0
                clocks[0] = 1.0
                S[T] = 0.0
        else:
            clocks[5] += dt[k]
            over = clocks[5] > memories[1] and (named < -clear or clocks[4] < 0.0)
            clocks[1] = clocks[1] + dt[k] if over else 0.0
            if clocks[1] >= confirm:
                clocks[:] = 0.0
                S[2:] = S[1]  # what the long memories hold is over
        if clocks[0] == 1:
            best, out_size[k], out_sd[k] = evidence_of(S[T], sd, unknown_sd, points, sizes, prior, count)
            best[F] -= penalty
            odds = np.exp(temper * (best - np.max(best)))
            out_p[k] = odds / odds.sum()
            clocks[2] = np.argmax(best[:F])
            clocks[3], clocks[4] = out_size[k, int(clocks[2])], np.max(best[:F])
        out_evidence[k] = best[:F]
        detection[k] = np.int8(clocks[0])
    return statistic, detection, out_evidence, out_p, out_size, out_sd
