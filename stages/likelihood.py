"""Likelihood of residuals under a hypothesis, with forgetting and with unknown run offsets.

For a residual e with spread sigma, weights ``w = min(dt, tau_c) / tau_c`` and forgetting ``exp(-age / T)``,
one keeps

    A = sum w h h' / sigma^2,   b = sum w h e / sigma^2,   q = sum w [(e / sigma)^2 + 2 ln sigma],

where h are the shapes of what differs from run to run, e.g. h = 1 for a plain offset, each with a coefficient
``c ~ N(0, s^2)``. Integrating c out gives the log-likelihood

    L = -1/2 [q - b' (A + diag(1 / s^2))^-1 b + ln |I + diag(s^2) A|].

Residuals add up. There are at most two shapes for a residual. What a relation is in doubt of (``model_sd``)
is shared by neighbouring samples too, so its remembered mean square ``D / A11`` is added to the first
``s^2``.

A spike must not decide. Before it is added, an e is held within ``clip`` spreads of what lies between zero
and its own mean over a short memory. Clipping e itself would hide the scatter of a large offset, and make
wrong hypotheses look better than right ones; and where a fault begins, the mean is of another time.

The compiler's cache does not see changes in another file: after a change here delete the compiled files of
:mod:`stages.evidence` (``stages/__pycache__/evidence*.nb*``).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
SUMS = 7  # A11, A12, A22, b1, b2, q, D


@njit(cache=True)
def tame(e: Array, sigma: Array, S: Array, clip: float, seen: float) -> Array:  # pragma: no cover - compiled
    """``e`` (points, residuals), held within ``clip`` spreads of what lies between zero and the means that
    ``S`` remembers. At a log's start, zero counts as one sample beside the ``seen`` independent ones."""
    tamed = e.copy()
    for p in range(e.shape[0]):
        for r in range(e.shape[1]):
            reach = clip * sigma[p, r]
            if abs(e[p, r]) > reach:
                mean = S[p, r, 3] / S[p, r, 0] * seen / (seen + 1.0) if S[p, r, 0] > 0 else 0.0
                tamed[p, r] = min(max(e[p, r], min(mean, 0.0) - reach), max(mean, 0.0) + reach)
    return tamed


@njit(cache=True)
def add_sample(
    S: Array, e: Array, sigma: Array, ln_sigma: Array, doubt: Array, shapes: Array, weights: Array
) -> None:  # pragma: no cover - compiled
    """Add one row to the sums ``S`` (points, residuals, SUMS) of one memory, in place."""
    for p in range(e.shape[0]):
        for r in range(e.shape[1]):
            x, s = e[p, r], sigma[p, r]
            if np.isnan(x) or np.isnan(s):
                continue
            weight = weights[r]
            w = weight / (s * s)
            h1, h2 = shapes[r, 0], shapes[r, 1]
            S[p, r, 0] += w * h1 * h1
            S[p, r, 1] += w * h1 * h2
            S[p, r, 2] += w * h2 * h2
            S[p, r, 3] += w * h1 * x
            S[p, r, 4] += w * h2 * x
            S[p, r, 5] += w * x * x + weight * 2.0 * ln_sigma[p, r]
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
