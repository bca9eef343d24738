"""Sums of the likelihood over many samples at once, where all of them are known: compiled.

The sums are those of :mod:`stages.likelihood`. A spike is held within ``clip`` spreads of what lies between
zero and the mean of all the samples, ``sum w e / sum w`` with ``w = weight / sigma^2``. Errors that samples
of a group share, such as a relation's doubt in a regime, are taken off before the groups are summed.

The compiler's cache does not see changes in another file, see :mod:`stages.likelihood`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.likelihood import (
    A11,
    A12,
    A22,
    B1,
    B2,
    SUMS,
    D,
    Q,
    add_logarithms,
    add_points,
    interpolate,
    precisions,
    tame,
)

Array = NDArray[np.float64]


class Blend(NamedTuple):
    """Of each point the computed ones on either side, and the share of the right one."""

    left: NDArray[np.uint64]
    right: NDArray[np.uint64]
    share: Array


def as_computed(points: int) -> Blend:
    """Every computed point as it is."""
    place = np.arange(points, dtype=np.uint64)
    return Blend(place, place, np.zeros(points))


@njit(cache=True, error_model="numpy")
def pooled(
    row: tuple[Array, Array, Array, Array, Array],
    blend: Blend,
    shapes: Array,
    weight: Array,
    clip: float,
    starts: NDArray[np.int64],
) -> Array:  # pragma: no cover - compiled
    """The sums, shape (residuals, SUMS, points); ``row``: e, sigma, ln sigma, the doubt that samples of a
    group share and what all share, each (rows, residuals, computed points), ``shapes`` (rows, residuals, 2),
    ``weight`` (rows, residuals), ``starts`` (groups + 1,) of the groups' rows."""
    e, sigma, ln_sigma, doubt, wrong = row
    left, right, share = blend
    N, R, P = e.shape[0], e.shape[1], len(left)
    S, T, x, s, w = np.zeros((R, SUMS, P)), np.empty((SUMS, P)), np.empty(P), np.empty(P), np.empty(P)
    ln_s, off, total, mean = np.empty(P), np.empty(P), np.empty(P), np.empty(P)
    square, mass = np.empty(P), np.empty(P)
    for r in range(R):
        total[:], mean[:], square[:], mass[:] = 1e-300, 0.0, 0.0, 1e-300
        for n in range(N):
            interpolate(e[n, r], left, right, share, x)
            interpolate(sigma[n, r], left, right, share, s)
            precisions(x, s, weight[n, r], w)
            for p in range(P):
                total[p] += w[p]
            for p in range(P):
                mean[p] += w[p] * x[p] if w[p] > 0.0 else 0.0
        for g in range(len(starts) - 1):
            T[:] = 0.0
            for n in range(starts[g], starts[g + 1]):
                h1 = shapes[n, r, 0]
                interpolate(e[n, r], left, right, share, x)
                interpolate(sigma[n, r], left, right, share, s)
                interpolate(ln_sigma[n, r], left, right, share, ln_s)
                interpolate(doubt[n, r], left, right, share, off)
                for p in range(P):
                    x[p] = tame(x[p], clip * s[p], mean[p] / total[p])
                precisions(x, s, weight[n, r], w)
                add_points(T, w, x, ln_s, off, h1, shapes[n, r, 1], weight[n, r])
                interpolate(wrong[n, r], left, right, share, off)
                for p in range(P):
                    mass[p] += w[p] * h1 * h1
                    square[p] += w[p] * h1 * h1 * off[p] * off[p] if w[p] > 0.0 else 0.0
            add_group(S[r], T)
        for p in range(P):
            S[r, D, p] = square[p] / mass[p] * S[r, A11, p]
    return S


@njit(cache=True, error_model="numpy")
def add_group(S: Array, T: Array) -> None:  # pragma: no cover - compiled
    """Add the sums ``T`` of a group of samples to ``S``, both (SUMS, points), once an error c h_1 that they
    share, ``c ~ N(0, v)`` with ``v = D / A11``, has been integrated out: with k = 1 / (1 + v A11)

        A11 k,  B1 k,  A12 k,  A22 - v k A12^2,  B2 - v k A12 B1,  Q - v k B1^2 + ln(1 + v A11).
    """
    shared = np.empty(S.shape[1])
    for p in range(S.shape[1]):
        a, b, a12 = T[A11, p], T[B1, p], T[A12, p]
        v = T[D, p] / a if a > 0.0 else 0.0
        shared[p] = 1.0 + v * a
        k = 1.0 / shared[p]
        S[A11, p] += a * k
        S[B1, p] += b * k
        S[Q, p] += T[Q, p] - v * k * b * b
        S[A12, p] += a12 * k
        S[A22, p] += T[A22, p] - v * k * a12 * a12
        S[B2, p] += T[B2, p] - v * k * a12 * b
    add_logarithms(S[Q], 1.0, shared)
