"""Bending: how much a relation errs beyond what it was trained on, for the curvature that it cannot know.

An affine model errs with the square of the distance to its samples. How much is learned by leaving out one
region after the other: of a left-out sample at novelty n (:mod:`stages.gsmms`) from the regions that remain,
models fitted without the region err by e, and as far as that exceeds the relation's own error,

    bend = median of sqrt(max(e^2 - rms^2, 0)) / n^2   over samples with n between NEAR and FAR,

in the unit of y. It is the median, as the errors of single regions differ widely, and a cautious figure:
regions within the map are left out, too, and their neighbours say much of them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from stages.gsmms import Gsmms, blended_gram, features, shrinkage, with_one

Array = NDArray[np.float64]
ROWS = 3000  # that are looked at
NEAR, FAR = 0.5, 2.0


def bend_of(model: Gsmms, S: Array, y: Array, weight: Array) -> float:
    """The bend of a fitted model from its training samples, regressors (N, d), outputs and weights (N,); 0
    where nothing can be left out."""
    rows = np.flatnonzero(np.isfinite(S).all(axis=1) & np.isfinite(y) & (weight > 0))
    rows = rows[:: max(1, -(-len(rows) // ROWS))]
    found = np.concatenate([np.empty((0, 3)), *_left_out(model, S[rows], y[rows], weight[rows])])
    novelty, error, mass = found[(found[:, 0] >= NEAR) & (found[:, 0] <= FAR)].T
    if not mass.size:
        return 0.0
    ratio = np.sqrt(np.maximum(error**2 - model.rms**2, 0.0)) / novelty**2
    order = np.argsort(ratio)
    total = np.cumsum(mass[order])
    return float(ratio[order][np.searchsorted(total, 0.5 * total[-1])])


def _left_out(model: Gsmms, S: Array, y: Array, weight: Array) -> Iterator[Array]:
    """Of each region's samples novelty, error and weight, (samples, 3), without the region."""
    nodes, unit = model.partition.nodes, model.partition.assign(S)
    centre = np.average(y, weights=weight)
    scale = float(np.sqrt(np.average((y - centre) ** 2, weights=weight))) or 1.0
    target = (y - centre) / scale
    prior = _prior(model, S, target, weight)
    for m in range(len(nodes)):
        here, others = unit == m, np.delete(np.arange(len(nodes)), m)
        if not here.any() or here.all():
            continue
        nearest = others[cdist(S[here], nodes[others]).argmin(axis=1)]
        off = np.einsum("nij,nj->ni", model.whiten[nearest], S[here] - model.mean[nearest])
        if model.width > 0:
            G, h = blended_gram(nodes[others], model.width, S[~here], target[~here], weight[~here])
            theta = np.linalg.solve(G.sum(axis=0) + np.diag(prior[: h.shape[1]]), h.sum(axis=0))
            predicted = centre + scale * features(S[here], nodes[others], model.width) @ theta
        else:  # hard regions know little of each other
            predicted = (with_one(S[here]) * model.theta[nearest]).sum(axis=1)
        novelty = np.sqrt((off**2).sum(axis=1)) / model.reach
        yield np.column_stack([novelty, y[here] - predicted, weight[here]])


def _prior(model: Gsmms, S: Array, target: Array, weight: Array) -> Array:
    """The precisions that the fit of all regions takes."""
    if model.width == 0:
        return np.empty(0)
    G, h = blended_gram(model.partition.nodes, model.width, S, target, weight)
    known = float(weight @ target**2)
    return shrinkage(G.sum(axis=0), h.sum(axis=0), known, float(weight.sum()), len(model.theta))[1]
