"""Forget: region-wise recursive least squares with a forgetting factor, (6.1) as printed; off by default.

With a residual's mean as the only parameter of a region, and the samples n_k that a drive k adds,

    P_k = lambda P_{k-1} + n_k,   m_k = m_{k-1} + n_k / P_k (r_k - m_{k-1}).

It follows wear, and takes every slow fault for normal just as well: in ``benchmarks.adaptation`` a sensor's
5 % over 20 drives is gone from the residuals 30 drives later. :mod:`stages.adapt` does not do that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError

Array = NDArray[np.float64]


def forgotten(mean: Array, count: Array, forgetting: float) -> Array:
    """What is taken for normal before each drive, (drives, residuals, regions), from the drives' region means
    and numbers of samples; 0 before the first.

    Raises:
        RecipeError: ``forgetting`` is not in (0, 1].

    >>> m = forgotten(np.ones((50, 1, 1)), np.ones((50, 1, 1)), 0.9)
    >>> float(m[0, 0, 0]), float(m[-1, 0, 0].round(6))
    (0.0, 1.0)
    """
    if not 0 < forgetting <= 1:
        raise RecipeError(f"forgetting = {forgetting}: expected above 0, at most 1 (1 forgets nothing)")
    out = np.zeros_like(mean)
    m, P = np.zeros(mean.shape[1:]), np.zeros(mean.shape[1:])
    for k in range(len(mean)):
        out[k] = m
        P = forgetting * P + count[k]
        m = m + np.where(count[k] > 0, count[k] / np.maximum(P, 1e-12) * (mean[k] - m), 0.0)
    return out
