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

from stages.likelihood import SUMS, add_point, tame

Array = NDArray[np.float64]


class Blend(NamedTuple):
    """Of each point the computed ones on either side, and the share of the right one."""

    left: NDArray[np.int64]
    right: NDArray[np.int64]
    share: Array


def as_computed(points: int) -> Blend:
    """Every computed point as it is."""
    place = np.arange(points)
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
    S, total, mean = np.zeros((R, SUMS, P)), np.empty(P), np.empty(P)
    for r in range(R):
        total[:], mean[:] = 1e-300, 0.0
        for n in range(N):
            for p in range(P):
                a, b, u = left[p], right[p], share[p]
                x = (1.0 - u) * e[n, r, a] + u * e[n, r, b]
                s = (1.0 - u) * sigma[n, r, a] + u * sigma[n, r, b]
                known = not (np.isnan(x) or np.isnan(s))
                w = weight[n, r] / (s * s) if known else 0.0
                total[p] += w
                mean[p] += w * x if known else 0.0
        for p in range(P):
            mean[p] /= total[p]
        for n in range(N):
            h1, h2 = shapes[n, r, 0], shapes[n, r, 1]
            for p in range(P):
                a, b, u = left[p], right[p], share[p]
                x = (1.0 - u) * e[n, r, a] + u * e[n, r, b]
                s = (1.0 - u) * sigma[n, r, a] + u * sigma[n, r, b]
                ln_s = (1.0 - u) * ln_sigma[n, r, a] + u * ln_sigma[n, r, b]
                off = (1.0 - u) * doubt[n, r, a] + u * doubt[n, r, b]
                add_point(S[r], p, tame(x, clip * s, mean[p]), s, ln_s, off, h1, h2, weight[n, r])
    return S
