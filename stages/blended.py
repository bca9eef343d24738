"""Blended: local affine models joined smoothly (Takagi and Sugeno 1985), with their evidence (MacKay 1992).

Regressors X, shape (N, k), and output y are standardised; the centres ``xi_1 .. xi_M`` lie in ``X T``:

    F = [1, x | w_1 (1, x) .. w_M (1, x)],   w_m = exp(-|x T - xi_m|^2 / 2 s^2) / sum_l ...

with ``s`` a factor times the mean distance to the nearest other centre. The coefficients have a prior of
precision 1 on the common affine part and ``lambda`` on the local deviations; with ``A = F'F + Lambda = L L'``
and ``z = L^-1 F'y``, minus twice the log evidence is, but for a constant,

    S = N ln((y'y - z'z) / N) + 2 sum ln L_ii - sum ln Lambda_ii.

It is a code length in nats times 2: it grows with what the data cannot determine, so M, ``lambda`` and s are
those of least S. The metric T is that of the curvature: where the fitted model's gradient g does not change,
resolution is wasted. ``T = Cov(g)^(1/4)``, largest eigenvalue 1, none below 0.02, is tried twice and costs
``k ln N``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs
from scipy.spatial.distance import cdist

from stages.tree import nested_centres

Array = NDArray[np.float64]
SHRINKAGE = (10.0, 1.0, 0.1, 0.01, 1e-3, 1e-4)
LEVELS = 5  # 2^5 = 32 centres at first, in the metric up to
MOST_LEVELS = 7
LEAST_ROWS_EACH, ROWS_EACH = 3, 6  # to a coefficient: of any model, and of one with more centres than before
GRADIENTS = 400  # rows at which the curvature is looked at
NARROWEST = 0.02  # eigenvalue of the metric
(_potrf, _trtrs) = get_lapack_funcs(("potrf", "trtrs"), dtype=np.float64)


Fit = Callable[[Array, Array], "Blended"]  # of centres and metric


@dataclass(frozen=True, eq=False)
class Blended:
    """A fitted model: ``centres`` (M, k) in X T, ``width`` s, ``theta`` ((M + 1) (k + 1)), the common part
    first; ``S`` with the price of the metric; ``square`` is y'y - z'z."""

    S: float
    centres: Array
    T: Array
    width: float
    shrinkage: float
    theta: Array
    square: float

    @property
    def M(self) -> int:
        return len(self.centres)

    def predict(self, X: Array) -> Array:
        """y for standardised regressors (N, k)."""
        return np.asarray(self.features(X) @ self.theta)

    def features(self, X: Array) -> Array:
        return features(X, X @ self.T, self.centres, self.width)

    def weights(self, X: Array) -> Array:
        """w, shape (N, M)."""
        exponent = -cdist(X @ self.T, self.centres, "sqeuclidean") / (2 * self.width**2)
        w = np.exp(exponent - exponent.max(axis=1, keepdims=True))
        return np.asarray(w / w.sum(axis=1, keepdims=True))

    def gradient(self, X: Array) -> Array:
        """dy/dx, shape (N, k)."""
        k = X.shape[1]
        theta = self.theta.reshape(-1, k + 1)
        common = np.broadcast_to(theta[0, 1:], X.shape)
        if self.M == 1:
            return common
        w, local = self.weights(X), theta[1:, 0] + X @ theta[1:, 1:].T  # (N, M)
        mixed = w @ self.centres
        turn = (w * local) @ self.centres - (w * local).sum(axis=1, keepdims=True) * mixed
        return np.asarray(common + w @ theta[1:, 1:] + turn @ self.T.T / self.width**2)


def features(X: Array, XT: Array, centres: Array, width: float) -> Array:
    """F, shape (N, (M + 1) (k + 1)); of a single centre only the common part."""
    M, k = len(centres), X.shape[1]
    F = np.empty((len(X), (M + 1) * (k + 1) if M > 1 else k + 1))
    _features(np.ascontiguousarray(X), XT, centres, 1.0 / (2 * width**2), F)
    return F


def fit_centres(
    X: Array,
    y: Array,
    centres: Array,
    T: Array,
    factors: Sequence[float] = (1.0,),
    weight: Array | None = None,
) -> Blended:
    """The model on given centres with the ``lambda`` and width of least S; ``weight``: of the rows, (N,)."""
    M, k = len(centres), X.shape[1]
    XT, spacing = X @ T, _spacing(centres)
    N = float(len(y) if weight is None else weight.sum())
    best: Blended | None = None
    for factor in factors if M > 1 else (1.0,):
        F = features(X, XT, centres, factor * spacing)
        Fw, yw = (F, y) if weight is None else (F * weight[:, None], y * weight)
        G, h, yy = F.T @ Fw, F.T @ yw, float(y @ yw)
        for shrinkage in SHRINKAGE:
            prior = np.ones(len(h))
            prior[k + 1 :] = shrinkage
            S, square, theta = _solve(G, h, yy, prior, N)
            if best is None or S < best.S:
                best = Blended(S, centres, T, factor * spacing, shrinkage, theta, square)
            if M == 1:  # there are no local deviations
                break
    assert best is not None
    return best


def fit_blended(
    X: Array,
    y: Array,
    *,
    passes: int = 2,
    factors: Sequence[float] = (1.0,),
    weight: Array | None = None,
    start: Blended | None = None,
    hopeless: float = np.inf,
) -> Blended:
    """The model of least S over M = 1, 2, 4 .. 32 and the metric; ``start``: a model whose metric, with a
    row for each column of ``X``, is tried too. One that is worse than ``hopeless`` then gets no metric of its
    own.

    >>> x = np.linspace(-2, 2, 400)[:, None]
    >>> model = fit_blended(x, np.abs(x[:, 0]))
    >>> model.M > 2, bool(np.abs(model.predict(x) - np.abs(x[:, 0])).max() < 0.2)
    (True, True)
    """

    def on(centres: Array, T: Array) -> Blended:
        return fit_centres(X, y, centres, T, factors, weight)

    best = _plain(X, on)
    if start is not None and start.M > 1:
        best = min(best, _around(start.M, X, start.T, on), key=lambda m: m.S)
    for _ in range(passes):
        if best.M == 1 or hopeless < best.S:
            break
        before = best.S
        best = min(best, _around(best.M, X, metric(best, X), on), key=lambda m: m.S)
        if before - best.S < 0.01 * len(y):
            break
    return best


def _plain(X: Array, on: Fit) -> Blended:
    """Over the levels of nested centres without a metric, stopping after three without gain."""
    T = np.eye(X.shape[1])
    first, *more = nested_centres(X, LEVELS)
    best, without = on(first, T), 0
    for centres in more:
        if without == 3 or not _affordable(centres, X, LEAST_ROWS_EACH):
            break
        model = on(centres, T)
        best, without = (model, 0) if model.S < best.S else (best, without + 1)
    return best


def _around(M: int, X: Array, T: Array, on: Fit) -> Blended:
    """The best number of centres in a metric, from M on downhill; the metric's price is paid."""
    nested = nested_centres(X @ T, MOST_LEVELS)
    level = max(min(round(math.log2(M)), len(nested) - 1), 0)
    best = on(nested[level], T)
    for step in (-1, 1):
        at = level + step
        while 1 <= at < len(nested) and _affordable(
            nested[at], X, ROWS_EACH if step > 0 else LEAST_ROWS_EACH
        ):
            other = on(nested[at], T)
            if other.S >= best.S:
                break
            best, at = other, at + step
        if at != level + step:  # downhill on this side
            break
    return replace(best, S=best.S + X.shape[1] * np.log(len(X)))


def _affordable(centres: Array, X: Array, rows_each: int) -> bool:
    """Whether there are so many rows to each coefficient."""
    return bool((len(centres) + 1) * (X.shape[1] + 1) * rows_each < len(X))


def metric(model: Blended, X: Array) -> Array:
    """T of the curvature, shape (k, k)."""
    some = X[:: max(1, len(X) // GRADIENTS)]
    values, vectors = np.linalg.eigh(np.cov(model.gradient(some).T).reshape(X.shape[1], -1))
    share = np.maximum(values / max(values[-1], 1e-300), NARROWEST**4) ** 0.25
    return np.asarray((vectors * share) @ vectors.T)


def _spacing(centres: Array) -> float:
    if len(centres) == 1:
        return 1.0
    apart = cdist(centres, centres)
    np.fill_diagonal(apart, np.inf)
    return max(float(apart.min(axis=1).mean()), 1e-6)


def _solve(G: Array, h: Array, yy: float, prior: Array, N: float) -> tuple[float, float, Array]:
    """S, y'y - z'z and the coefficients."""
    A = G.copy()
    A[np.diag_indices_from(A)] += prior
    L, _ = _potrf(A, lower=1, overwrite_a=1)
    z, _ = _trtrs(L, h, lower=1)
    square = max(float(yy - z @ z), 1e-12 * yy)
    S = N * np.log(square / N) + 2 * np.log(np.diag(L)).sum() - np.log(prior).sum()
    theta, _ = _trtrs(L, z, lower=1, trans=1)
    return float(S), square, theta


@njit(cache=True, fastmath=True)
def _features(X: Array, XT: Array, centres: Array, sharp: float, F: Array) -> None:  # pragma: no cover
    N, k = X.shape
    M = centres.shape[0]
    w = np.empty(M)
    for r in range(N):
        F[r, 0] = 1.0
        for j in range(k):
            F[r, 1 + j] = X[r, j]
        if M == 1:
            continue
        least = 1e300
        for m in range(M):
            d = 0.0
            for j in range(XT.shape[1]):
                d += (XT[r, j] - centres[m, j]) ** 2
            w[m] = d * sharp
            least = min(least, w[m])
        total = 0.0
        for m in range(M):
            w[m] = np.exp(least - w[m])
            total += w[m]
        for m in range(M):
            share = w[m] / total
            at = (m + 1) * (k + 1)
            F[r, at] = share
            for j in range(k):
                F[r, at + 1 + j] = share * X[r, j]
