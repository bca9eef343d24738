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

Between two computed sizes of a hypothesis, e, sigma, its logarithm and the doubt are interpolated linearly.
The last point of all sums is the log as it is, untamed, for ``unknown``.

The compiler's cache does not see changes in another file: after a change here delete the compiled files of
:mod:`stages.memory`, :mod:`stages.episode` and :mod:`stages.evidence` (``stages/__pycache__/*.nb*``).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.size_grid import Grid

Array = NDArray[np.float64]
A11, B1, Q, D, A12, A22, B2 = range(7)
CENTRE, LN_2 = 0.5**0.5, 0.6931471805599453
SUMS, PLAIN = 7, 4  # sums; those needed where there is one shape


@njit(cache=True, error_model="numpy")
def tame(x: float, reach: float, mean: float) -> float:  # pragma: no cover - compiled
    """``x``, held within ``reach`` of what lies between zero and ``mean``."""
    return min(max(x, min(mean, 0.0) - reach), max(mean, 0.0) + reach)


@njit(cache=True, error_model="numpy")
def interpolate(
    y: Array, left: NDArray[np.uint64], right: NDArray[np.uint64], share: Array, out: Array
) -> None:  # pragma: no cover - compiled
    """``y`` (computed points,) at the points between them, to ``out``."""
    for p in range(len(left)):
        out[p] = (1.0 - share[p]) * y[left[p]] + share[p] * y[right[p]]


@njit(cache=True, error_model="numpy")
def precisions(x: Array, s: Array, weight: float, w: Array) -> None:  # pragma: no cover - compiled
    """``w = weight / s^2``; 0 where the residual ``x`` or its spread ``s`` is missing."""
    for p in range(len(w)):
        w[p] = 0.0 if np.isnan(x[p]) or np.isnan(s[p]) else weight / (s[p] * s[p])


@njit(cache=True, error_model="numpy")
def add_points(
    S: Array, w: Array, x: Array, ln_s: Array, off: Array, h1: float, h2: float, weight: float
) -> None:  # pragma: no cover - compiled
    """Add a residual ``x`` of precision ``w``, spread exp ``ln_s`` and doubt ``off``, each (points,), to the
    sums ``S`` (SUMS, points), but where it is missing.

    A loop for each sum and without branches, so that the compiler takes several points at a time.
    """
    for p in range(len(w)):
        S[A11, p] += w[p] * h1 * h1
    for p in range(len(w)):
        S[B1, p] += w[p] * h1 * x[p] if w[p] > 0.0 else 0.0
    for p in range(len(w)):
        S[Q, p] += w[p] * x[p] * x[p] + 2.0 * weight * ln_s[p] if w[p] > 0.0 else 0.0
    for p in range(len(w)):
        S[D, p] += w[p] * h1 * h1 * off[p] * off[p] if w[p] > 0.0 else 0.0
    if h2 != 0.0:
        for p in range(len(w)):
            S[A12, p] += w[p] * h1 * h2
        for p in range(len(w)):
            S[A22, p] += w[p] * h2 * h2
        for p in range(len(w)):
            S[B2, p] += w[p] * h2 * x[p] if w[p] > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def add_sample(
    S: Array,
    row: tuple[Array, Array, Array, Array],
    grid: Grid,
    shapes: Array,
    weights: Array,
    short: Array,
    seen: float,
    clip: float,
) -> None:  # pragma: no cover - compiled
    """Add one row to the sums ``S`` (residuals, SUMS, points), in place.

    ``row``: e, sigma, ln sigma and doubt at the computed sizes, each (residuals, computed points); ``shapes``
    (residuals, 2); ``weights`` (residuals,). ``short``: the sums of the short memory, in which zero counts as
    one sample beside the ``seen`` independent ones, as at a log's start.
    """
    e, sigma = row[0], row[1]
    P = len(grid.left)
    at, w = np.empty((4, P + 1)), np.empty(P + 1)
    x, s, told = at[0], at[1], seen / (seen + 1.0)
    for r in range(S.shape[0]):
        if np.isnan(e[r, 0]) or np.isnan(sigma[r, 0]):  # the log as it is cannot be compared
            continue
        for k, y in enumerate(row):
            interpolate(y[r], grid.left, grid.right, grid.share, at[k])
            at[k, P] = y[r, 0]
        for p in range(P):
            mean = short[r, B1, p] / max(short[r, A11, p], 1e-300) * told
            x[p] = tame(x[p], clip * s[p], mean)
        precisions(x, s, weights[r], w)
        add_points(S[r], w, x, at[2], at[3], shapes[r, 0], shapes[r, 1], weights[r])


@njit(cache=True, error_model="numpy")
def fade(S: Array, kept: float, fresh: Array, sd: Array) -> None:  # pragma: no cover - compiled
    """``S = kept S + fresh``, in place, where ``sd`` (residuals, 2) says which residuals have two shapes."""
    for r in range(S.shape[0]):
        for k in range(SUMS if sd[r, 1] > 0 else PLAIN):
            for p in range(S.shape[2]):
                S[r, k, p] = kept * S[r, k, p] + fresh[r, k, p]


@njit(cache=True, error_model="numpy")
def overwrite(S: Array, sums: Array) -> None:  # pragma: no cover - compiled
    """``S = sums``, in place. Unlike an assignment it is compiled at once."""
    for r in range(S.shape[0]):
        for k in range(SUMS):
            for p in range(S.shape[2]):
                S[r, k, p] = sums[r, k, p]


@njit(cache=True, error_model="numpy")
def log_likelihoods(S: Array, sd: Array, unknown_sd: Array) -> Array:  # pragma: no cover - compiled
    """L of every point, the last with offsets of ``unknown_sd``; ``S`` (residuals, SUMS, points), ``sd`` and
    ``unknown_sd`` (residuals, 2), a standard deviation 0 where there is no shape.

    Written for ``s^2 A``, so that s = 0 needs no inverse.
    """
    P = S.shape[2]
    L, determinant = np.zeros(P), np.ones(P)
    for r in range(S.shape[0]):
        v2 = sd[r, 1] * sd[r, 1]
        for p in range(P):
            v1 = sd[r, 0] * sd[r, 0] if p < P - 1 else unknown_sd[r, 0] * unknown_sd[r, 0]
            if S[r, A11, p] > 0:
                v1 += S[r, D, p] / S[r, A11, p]
            b1, det = S[r, B1, p], 1.0 + v1 * S[r, A11, p]
            if v2 == 0.0:
                explained = v1 * b1 * b1 / det
            else:
                a11, a12, a22, b2 = det, S[r, A12, p], 1.0 + v2 * S[r, A22, p], S[r, B2, p]
                det = a11 * a22 - v1 * v2 * a12 * a12
                # b' (A + V^-1)^-1 b = b' V (I + A V)^-1 b for V = diag(v1, v2)
                explained = (v1 * a22 * b1 * b1 - 2.0 * v1 * v2 * a12 * b1 * b2 + v2 * a11 * b2 * b2) / det
            L[p] -= 0.5 * (S[r, Q, p] - explained)
            determinant[p] *= det
    add_logarithms(L, -0.5, determinant)
    return L


@njit(cache=True, error_model="numpy")
def offsets_known(
    recent: Array, whole: Array, sd: Array, wander: Array
) -> bool:  # pragma: no cover - compiled
    """Whether what came before the ``recent`` in the ``whole`` says as much of all offsets as is supposed."""
    for r in range(len(sd)):
        before = whole[r, A11, 0] - recent[r, A11, 0]
        if sd[r, 0] > 0 and (wander[r] >= sd[r, 0] or before * sd[r, 0] ** 2 < 1.0):
            return False
    return True


@njit(cache=True, error_model="numpy")
def informed(
    recent: Array, whole: Array, taken: Array, wander: Array, prior: Array, sd: Array
) -> Array:  # pragma: no cover - compiled
    """Sums of the ``recent`` under every point, and of what came before it, the ``whole`` less what is
    ``taken`` off, under none but those with a ``prior``, which healthy logs show.

    So the offsets are known from before, but for what they ``wander`` within a log, a standard deviation
    (residuals,): what was before counts as no more than would tell them so well. ``sd`` as in :func:`fade`.
    """
    sums, P = np.empty(recent.shape), recent.shape[2]
    for r in range(recent.shape[0]):
        information = (whole[r, A11, 0] - taken[r, A11, 0]) * wander[r] ** 2
        share = min(1.0, 1.0 / information) if information > 0 else 0.0
        for k in range(SUMS if sd[r, 1] > 0 else PLAIN):
            before = share * (whole[r, k, 0] - taken[r, k, 0])
            for p in range(P):
                sums[r, k, p] = recent[r, k, p] + before
            for p in range(P):
                if p == P - 1 or prior[p] > -np.inf:
                    sums[r, k, p] = recent[r, k, p] + share * (whole[r, k, p] - taken[r, k, p])
    return sums


@njit(cache=True, error_model="numpy")
def add_logarithms(L: Array, factor: float, x: Array) -> None:  # pragma: no cover - compiled
    """``L += factor ln x`` for normal x > 0, in place.

    With ``x = 2^k m``, m in [1/2, 1) from its bits, and ``s = (m - c) / (m + c)``, ``c = 1 / sqrt(2)``:
    ``ln x = (k - 1/2) ln 2 + 2 (s + s^3 / 3 + ... + s^15 / 15)``, to 1e-14. Unlike a library's it is computed
    for several points at a time.
    """
    bits = x.view(np.int64)
    mantissa = ((bits & 0x000FFFFFFFFFFFFF) | 0x3FE0000000000000).view(np.float64)
    for p in range(len(x)):
        s = (mantissa[p] - CENTRE) / (mantissa[p] + CENTRE)
        z = s * s
        series = 1 / 7 + z * (1 / 9 + z * (1 / 11 + z * (1 / 13 + z / 15)))
        series = s * (1.0 + z * (1 / 3 + z * (1 / 5 + z * series)))
        L[p] += factor * (((bits[p] >> 52) - 1022.5) * LN_2 + 2.0 * series)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def evidence_of(
    L: Array, grid: Grid, evidence: Array, size: Array, size_sd: Array
) -> None:  # pragma: no cover - compiled
    """Fill in the evidence of every fault, and last of ``unknown``; sizes and their standard deviations."""
    F, H = grid.points.shape[0], len(L) - 1
    healthy, top = 0.0, -np.inf
    for p in range(H):
        top = max(top, L[p] + grid.prior[p])
    for p in range(H):
        if grid.prior[p] > -np.inf:
            healthy += np.exp(L[p] + grid.prior[p] - top)
    healthy = top + np.log(healthy)
    heights = np.empty(grid.points.shape[1])
    for f in range(F):
        x = grid.sizes[f, : grid.counts[f]]
        for i in range(len(x)):
            heights[i] = L[grid.points[f, i]]
        size[f], height, size_sd[f] = peak(x, heights)
        width = min(1.0, np.sqrt(2.0 * np.pi) * size_sd[f] / (x[-1] - x[0]))
        evidence[f] = height + np.log(width) - healthy
    evidence[F] = L[H] - healthy
