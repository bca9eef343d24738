"""Curved: a map whose regions are small where a relation is curved.

The metric T and the number of regions are those of the smoothly blended model of most evidence
(:mod:`stages.blended`). A GSMMS (:mod:`stages.gsmms`) on ``s T`` has the same local affine models as one on
s, with regions and blending that follow the curvature; its prior, too, then holds slopes together where they
do not change.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from stages.blended import fit_blended
from stages.partition import Partition, edges

Array = NDArray[np.float64]
ROWS = 10_000  # on which the metric is found
PASSES = 3


def curved_map(S: Array, y: Array, weight: Array) -> tuple[Array, Partition]:
    """T, shape (d, d), and the map of ``S T``, for regressors ``S`` (N, d), outputs and weights (N,).

    >>> s = np.random.default_rng(0).uniform(size=(2000, 2))
    >>> T, _ = curved_map(s, np.sin(9 * s[:, 0]) + s[:, 1], np.ones(2000))
    >>> bool(np.linalg.norm(T[0]) > 5 * np.linalg.norm(T[1]))
    True
    """
    some = slice(None, None, -(-len(S) // ROWS))
    centre, spread = S[some].mean(axis=0), S[some].std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    target = (y[some] - y[some].mean()) / (y[some].std() or 1.0)
    with threadpool_limits(1, user_api="blas"):
        model = fit_blended((S[some] - centre) / spread, target, passes=PASSES, weight=weight[some])
    T = model.T / spread[:, None]
    nodes = model.centres + centre @ T
    return T, Partition(nodes, edges(nodes, S[some] @ T))
