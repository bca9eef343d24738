"""GSMMS: growing structure multiple model systems, one static relation ``y = f(x)`` each.

A self-organising map (:mod:`stages.partition`) cuts the space of normalised regressors ``s`` into M regions;
each has an affine model, and the prediction (5.44) is ``y = sum_m nu_m(s) (a_m + b_m s)``.

- ``hard``: ``nu_m = 1`` in region m, else 0 (5.45). Parameters from weighted least squares (5.50), with
  weights ``w_m(i) = exp(-dis(m, c(i))^2 / 2 sigma^2)`` (5.49) over *all* samples; as printed the sum runs
  over region m alone, where every weight is 1. The weight depends on a sample's region only, so the weighted
  Gram matrix is a mix of the regions' Gram matrices.
- ``blended``: ``nu_m ~ exp(-|s - xi_m|^2 / 2 w^2)`` normalised to sum 1 (Takagi-Sugeno). All regions are
  fitted jointly, ``theta_m = theta_0 + delta_m`` with a prior of precision ``lambda`` on ``delta``;
  ``lambda`` and the width ``w`` maximise the evidence ``-1/2 [N ln RSS + ln |A| - ln |Lambda|]`` (MacKay
  1992).

Where training data is thin the parameters are uncertain, and samples of one drive are not independent. So the
doubt about a prediction is the jackknife's over B blocks of consecutive samples (Kunsch 1989):
``doubt(s)^2 = (B - 1) / B sum_b (y_b(s) - mean y_b(s))^2 = |phi' R|^2``, where ``y_b`` was fitted without
block b, ``phi(s) = nu(s) x (1, s)``, and the columns of R are the parameters' deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ingest.errors import LogError
from stages.evaluation import Evaluation, evaluate
from stages.partition import CHUNK, Growth, Partition, grow

BLOCKS = 20
WIDTH_ROWS = 40_000  # of more rows every n-th chooses the width
INSIDE = 0.995  # share of the samples in the domain: a region with outliers must not widen all others'
Array = NDArray[np.float64]
Combination = Literal["hard", "blended"]


@dataclass(frozen=True, eq=False)
class Gsmms:
    """A fitted relation.

    ``theta``: (M, d + 1), row m is ``[a_m, b_m]``; ``root``: R, (M (d + 1), BLOCKS). ``width``: of the
    blending in s, 0 for hard regions.
    ``mean`` (M, d) and ``whiten`` (M, d, d): the training samples of a region, for the whitened distance
    ``|whiten_m (s - mean_m)|`` to what the region has seen; ``reach``: that distance's limit; ``bend``: what
    the prediction errs by at that limit, for curvature (:mod:`stages.bending`).
    """

    partition: Partition
    theta: Array
    root: Array
    rms: float
    width: float
    mean: Array
    whiten: Array
    reach: float
    bend: float = 0.0

    @cached_property
    def _linear(self) -> Array:
        """What makes the deviations and at last the prediction of the blended regressors."""
        return np.vstack([self.root.T, self.theta.ravel()])

    def evaluate(self, S: Array) -> Evaluation:
        """Prediction, doubt, novelty and region for normalised regressors ``S`` (N, d), each of shape (N,).

        The doubt is the prediction's standard deviation for want of training data, in the unit of y. The
        novelty is the whitened distance to the best matching region's training samples over ``reach``; above
        1 the sample is out of the trained domain.
        """
        return Evaluation(
            *evaluate(
                np.ascontiguousarray(S), self.partition.nodes, self.width, self._linear, self.mean,
                self.whiten, self.reach,
            )
        )  # fmt: skip

    def predict(self, S: Array) -> Array:
        """``y`` for normalised regressors ``S`` (N, d), shape (N,); NaN where a regressor is missing."""
        return self.evaluate(S).prediction

    def to_arrays(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
        return {
            "nodes": self.partition.nodes, "edges": self.partition.edges, "theta": self.theta,
            "root": self.root, "rms": np.array(self.rms), "width": np.array(self.width),
            "mean": self.mean, "whiten": self.whiten, "reach": np.array(self.reach),
            "bend": np.array(self.bend),
        }  # fmt: skip

    @classmethod
    def from_arrays(cls, a: dict[str, NDArray[np.float64]]) -> Gsmms:
        partition = Partition(a["nodes"], a["edges"].astype(np.int64))
        return cls(
            partition, a["theta"], a["root"], float(a["rms"]), float(a["width"]),
            a["mean"], a["whiten"], float(a["reach"]), float(a.get("bend", np.zeros(()))),
        )  # fmt: skip


def fit_gsmms(
    S: Array,
    y: Array,
    weight: Array | None = None,
    own: Array | None = None,
    *,
    growth: Growth | None = None,
    combination: Combination = "blended",
    neighbourhood: float = 0.4,
    partition: Partition | None = None,
) -> Gsmms:
    """Fit ``y`` (N,) on normalised regressors ``S`` (N, d) with sample weights (N,); incomplete rows do not
    count. ``own`` (N,) are further weights for the parameters, not for the map and the domain.

    ``neighbourhood`` is sigma of (5.49) in edges of the map, for ``hard`` regions. With ``partition`` given
    no map is grown.

    Raises:
        LogError: fewer complete rows than three per parameter of one affine model.

    >>> s = np.linspace(0, 1, 400)[:, None]
    >>> model = fit_gsmms(s, np.sin(6 * s[:, 0]), growth=Growth(nodes=8))
    >>> bool(np.abs(model.predict(s) - np.sin(6 * s[:, 0])).max() < 0.05)
    True
    """
    weight = np.ones(len(y)) if weight is None else weight
    own = np.ones(len(y)) if own is None else own
    known = np.isfinite(S).all(axis=1) & np.isfinite(y) & (weight > 0)
    S, y, weight, own = S[known], y[known], weight[known], (weight * own)[known]
    if len(S) < 3 * (S.shape[1] + 1):
        raise LogError(
            f"{len(S)} complete samples are too few for a model with {S.shape[1]} regressors; "
            f"at least {3 * (S.shape[1] + 1)} are needed: take longer or more fault-free logs"
        )
    partition = partition or grow(S, y, weight, growth)
    if combination == "hard" or len(partition.nodes) == 1:
        theta, root, width = *_fit_hard(partition, S, y, own, neighbourhood), 0.0
    else:
        theta, root, width = _fit_blended(partition.nodes, S, y, own)
    mean, whiten, reach = _domain(partition, S, weight)
    model = Gsmms(partition, theta, root, 1.0, width, mean, whiten, reach)
    return replace(model, rms=float(np.sqrt(np.average((y - model.predict(S)) ** 2, weights=weight))))


def with_one(S: Array) -> Array:
    return np.column_stack([np.ones(len(S)), S])


def blend(S: Array, nodes: Array, width: float) -> Array:
    exponent = -cdist(S, nodes, "sqeuclidean") / (2 * width**2)
    nu = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    return np.asarray(nu / nu.sum(axis=1, keepdims=True))


def _blocks(N: int) -> list[slice]:
    """The rows in BLOCKS parts, one after the other."""
    edges = np.linspace(0, N, BLOCKS + 1).astype(int)
    return [slice(a, b) for a, b in pairwise(edges)]


def _jackknife(G: Array, h: Array, solve: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """Theta (M, k) from all blocks' Gram matrices (first axis), and the root of its jackknife covariance."""
    all_G, all_h = G.sum(axis=0), h.sum(axis=0)
    without = np.stack([solve(all_G - g, all_h - x).ravel() for g, x in zip(G, h, strict=True)])
    root = np.sqrt((len(G) - 1) / len(G)) * (without - without.mean(axis=0)).T
    return solve(all_G, all_h), root


def _fit_hard(
    partition: Partition, S: Array, y: Array, weight: Array, neighbourhood: float
) -> tuple[Array, Array]:
    """(5.48)-(5.50) from the regions' Gram matrices."""
    X, unit = with_one(S), partition.assign(S)
    rows = [
        [np.flatnonzero(unit[b] == m) + b.start for m in range(len(partition.nodes))] for b in _blocks(len(S))
    ]
    G = np.array([[X[r].T @ (X[r] * weight[r, None]) for r in regions] for regions in rows])
    h = np.array([[X[r].T @ (weight[r] * y[r]) for r in regions] for regions in rows])
    mix = np.exp(-(partition.distances() ** 2) / (2 * neighbourhood**2))

    def solve(G: Array, h: Array) -> Array:
        inverse = np.linalg.pinv(np.einsum("mc,cij->mij", mix, G), hermitian=True)
        return np.asarray(np.einsum("mij,mj->mi", inverse, mix @ h))

    return _jackknife(G, h, solve)


def _fit_blended(nodes: Array, S: Array, y: Array, weight: Array) -> tuple[Array, Array, float]:
    """Joint shrunk least squares; ``lambda`` and the width by evidence. Theta, root, width."""
    M = len(nodes)
    centre, scale = np.average(y, weights=weight), np.sqrt(np.cov(y, aweights=weight, ddof=0)) or 1.0
    target, N = (y - centre) / scale, weight.sum()
    yy = float(weight @ target**2)
    apart = cdist(nodes, nodes) + np.diag(np.full(M, np.inf))
    spacing = float(apart.min(axis=1).mean())
    step = max(1, -(-len(S) // WIDTH_ROWS))
    some = [x[::step] for x in (S, target, weight)]
    share = float(N / some[2].sum())
    best: tuple[float, float, Array, Array] | None = None
    for factor in (0.7, 1.0, 1.4, 2.0):
        G, h = blended_gram(nodes, factor * spacing, *some)
        known = float(some[2] @ some[1] ** 2)
        cost, _ = shrinkage(share * G.sum(axis=0), share * h.sum(axis=0), share * known, float(N), M)
        if best is None or cost < best[0]:
            best = (cost, factor * spacing, G, h)
    assert best is not None
    _, width, G, h = best
    if step > 1:
        G, h = blended_gram(nodes, width, S, target, weight)
    _, prior = shrinkage(G.sum(axis=0), h.sum(axis=0), yy, float(N), M)
    theta, root = solve_blended(G, h, prior, M)
    theta = scale * theta
    theta[:, 0] += centre
    return theta, scale * root, width


def shrinkage(G: Array, h: Array, yy: float, N: float, M: int) -> tuple[float, Array]:
    """Minus twice the log evidence and the prior's precisions, (parameters,), for the best ``lambda``, from
    the Gram matrix and moments of all rows; outputs are standardised."""
    k = len(h) // (M + 1)
    best: tuple[float, Array] | None = None
    for shrink in (0.01, 0.1, 1.0, 10.0):
        prior = np.concatenate([np.full(k, 1e-6), np.full(M * k, shrink)])
        L = np.linalg.cholesky(G + np.diag(prior))
        z = np.linalg.solve(L, h)
        left = N * np.log(max(yy - float(z @ z), 1e-12 * yy) / N)
        cost = float(left + 2 * np.log(np.diag(L)).sum() - np.log(prior).sum())
        if best is None or cost < best[0]:
            best = (cost, prior)
    assert best is not None
    return best


def solve_blended(G: Array, h: Array, prior: Array, M: int) -> tuple[Array, Array]:
    """Theta (M, k) and the root of its jackknife covariance, (M k, blocks), from the blocks' Gram
    matrices."""
    k = h.shape[1] // (M + 1)
    total = np.hstack([np.tile(np.eye(k), (M, 1)), np.eye(M * k)])  # theta_m = theta_0 + delta_m
    precision = np.diag(prior)
    theta, root = _jackknife(G, h, lambda G, h: total @ np.linalg.solve(G + precision, h))
    return theta.reshape(M, k), root


def blended_gram(nodes: Array, width: float, S: Array, target: Array, weight: Array) -> tuple[Array, Array]:
    """Gram matrices and moments of the features ``(1, s), nu_m(s) (1, s)`` by block."""
    size = (len(nodes) + 1) * (S.shape[1] + 1)
    G, h = np.zeros((BLOCKS, size, size)), np.zeros((BLOCKS, size))
    for b, block in enumerate(_blocks(len(S))):
        for i in range(block.start, block.stop, CHUNK):
            rows = slice(i, min(i + CHUNK, block.stop))
            F = features(S[rows], nodes, width)
            G[b] += F.T @ (F * weight[rows, None])
            h[b] += F.T @ (weight[rows] * target[rows])
    return G, h


def features(S: Array, nodes: Array, width: float) -> Array:
    """``(1, s), nu_m(s) (1, s)``, shape (N, (M + 1) (d + 1))."""
    X = with_one(S)
    local = blend(S, nodes, width)[:, :, None] * X[:, None, :]
    return np.hstack([X, local.reshape(len(X), -1)])


def _domain(partition: Partition, S: Array, weight: Array) -> tuple[Array, Array, float]:
    """Mean and whitening of each region's samples, and the whitened distance within which ``INSIDE`` of all
    are."""
    unit, M = partition.assign(S), len(partition.nodes)
    mass = np.asarray(np.bincount(unit, weight, minlength=M), dtype=float)
    first = np.array([np.bincount(unit, weight * s, minlength=M) for s in S.T], dtype=float).T
    pairs = [[np.bincount(unit, weight * a * b, minlength=M) for b in S.T] for a in S.T]
    mean, whiten = region_spread(partition.nodes, mass, first, np.moveaxis(np.array(pairs), 2, 0))
    away = np.sqrt((np.einsum("nij,nj->ni", whiten[unit], S - mean[unit]) ** 2).sum(axis=1))
    order = np.argsort(away)
    total = np.cumsum(weight[order])
    return mean, whiten, float(away[order][np.searchsorted(total, INSIDE * total[-1])])


def region_spread(nodes: Array, mass: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Mean (M, d) and whitening (M, d, d) of each region from its weighted sums of 1 (M,), s (M, d) and s s'
    (M, d, d)."""
    M, d = nodes.shape
    all_mean = first.sum(axis=0) / mass.sum()
    common = second.sum(axis=0) / mass.sum() - np.outer(all_mean, all_mean)
    common = common / M ** (2 / d)  # a region of average size
    mean, whiten = nodes.copy(), np.empty((M, d, d))
    prior = d + 2
    visited = mass >= prior
    visited |= not visited.any()
    for m in np.flatnonzero(visited):
        mean[m] = first[m] / max(mass[m], 1e-300)
        own = second[m] / max(mass[m], 1e-300) - np.outer(mean[m], mean[m])
        spread = (mass[m] * own + prior * common) / (mass[m] + prior)
        whiten[m] = np.linalg.inv(np.linalg.cholesky(spread + 1e-9 * np.eye(d)))
    for m in np.flatnonzero(
        ~visited
    ):  # nobody has been here: what counts is how far it is from where one was
        nearest = np.flatnonzero(visited)[cdist(nodes[[m]], nodes[visited]).argmin()]
        mean[m], whiten[m] = mean[nearest], whiten[nearest]
    return mean, whiten
