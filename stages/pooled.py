"""Sums of the likelihood over many samples at once, where all of them are known: compiled.

The sums are those of :mod:`stages.likelihood`. A spike is held within ``clip`` spreads of what lies between
zero and the mean of all the samples, ``sum w e / sum w`` with ``w = weight / sigma^2``.

The compiler's cache does not see changes in another file, see :mod:`stages.likelihood`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.likelihood import SUMS, add_points, interpolate, precisions, tame

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
    row: tuple[Array, Array, Array, Array], blend: Blend, shapes: Array, weight: Array, clip: float
) -> Array:  # pragma: no cover - compiled
    """The sums, shape (residuals, SUMS, points); ``row``: e, sigma, ln sigma and doubt, each (rows,
    residuals, computed points), ``shapes`` (rows, residuals, 2), ``weight`` (rows, residuals)."""
    e, sigma, ln_sigma, doubt = row
    left, right, share = blend
    N, R, P = e.shape[0], e.shape[1], len(left)
    S, x, s, w = np.zeros((R, SUMS, P)), np.empty(P), np.empty(P), np.empty(P)
    ln_s, off, total, mean = np.empty(P), np.empty(P), np.empty(P), np.empty(P)
    for r in range(R):
        total[:], mean[:] = 1e-300, 0.0
        for n in range(N):
            interpolate(e[n, r], left, right, share, x)
            interpolate(sigma[n, r], left, right, share, s)
            precisions(x, s, weight[n, r], w)
            for p in range(P):
                total[p] += w[p]
            for p in range(P):
                mean[p] += w[p] * x[p] if w[p] > 0.0 else 0.0
        for n in range(N):
            interpolate(e[n, r], left, right, share, x)
            interpolate(sigma[n, r], left, right, share, s)
            interpolate(ln_sigma[n, r], left, right, share, ln_s)
            interpolate(doubt[n, r], left, right, share, off)
            for p in range(P):
                x[p] = tame(x[p], clip * s[p], mean[p] / total[p])
            precisions(x, s, weight[n, r], w)
            add_points(S[r], w, x, ln_s, off, shapes[n, r, 0], shapes[n, r, 1], weight[n, r])
    return S
