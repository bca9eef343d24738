"""Subspace identification: a linear model from inputs and outputs, without iteration.

Identifies, from y (N, l) and u (N, m), the innovations form (3.10) of the dissertation

    x(t+1) = A x(t) + B u(t) + K e(t),      y(t) = C x(t) + D u(t) + e(t).

All that is needed of the data is the Gram matrix of lagged samples, ``G = sum_t phi_t phi_t'`` with
``phi_t = [z_t, ..., z_(t+2r-1)]``, z = [y, u]. Gram matrices of adjoining stretches add up. With its rows in
the order future inputs, past, future outputs, ``G = L L'`` is the LQ factorisation in which MOESP, N4SID and
CVA differ by the weights of (3.8) only:

    MOESP   SVD of L32                      N4SID   SVD of L32 inv(L22) [L21 L22]
    CVA     SVD of S^-1 L32, S S' = L32 L32' + L33 L33': its singular values are canonical correlations

The observability matrix Gamma gives A and C by its shift invariance, the state is ``x_t = pinv(Gamma) L32
inv(L22) past_t``, and B, D, K follow by regression on the state, without a Riccati equation (W. Larimore,
ACC 1983; M. Verhaegen, Automatica 30, 1994; P. Van Overschee, B. De Moor, Subspace Identification, 1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.errors import LogError
from stages.statespace import StateSpace

Array = NDArray[np.float64]
Method = Literal["cva", "moesp", "n4sid"]
METHODS: tuple[Method, ...] = ("cva", "moesp", "n4sid")
SINGULAR = 1e-13  # a pivot below this share of its diagonal is rounding


@dataclass(frozen=True, kw_only=True, eq=False)
class LagGram:
    """``sum_t phi_t phi_t'`` over ``count`` times, shape (2 r p, 2 r p), p = l + m; ``outputs`` is l."""

    gram: Array
    count: int
    outputs: int
    signals: int

    def __add__(self, other: LagGram) -> LagGram:
        return LagGram(
            gram=self.gram + other.gram, count=self.count + other.count, outputs=self.outputs,
            signals=self.signals,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """A model, the singular values of (3.8) before truncation, and the criterion over the orders 0, 1, ...
    that chose ``order`` where none was given (None where one was)."""

    model: StateSpace
    order: int
    singular_values: Array
    criterion: Array | None


def lag_gram(y: Array, u: Array, horizon: int) -> LagGram:
    """The Gram matrix of ``2 horizon`` lags of y (N, l) and u (N, m), over ``N - 2 horizon + 1`` times.

    Only its first block row is summed over time; the rest follows by adding and subtracting samples at the
    ends: ``G[i+1, j+1] = G[i, j] - z_i z_j' + z_(T+i) z_(T+j)'``. Adjoining stretches overlap by ``2
    horizon - 1`` samples.

    Raises:
        LogError: fewer samples than lags.
    """
    p, N = y.shape[1] + u.shape[1], len(y)
    z, lags = np.empty((p, N)), 2 * horizon
    z[: y.shape[1]], z[y.shape[1] :] = y.T, u.T
    if 2 * lags > N:
        raise LogError(
            f"{N} samples are too few for subspace identification over {lags} lags; give {2 * lags}"
        )
    return LagGram(gram=_lag_gram(z, lags), count=N - lags + 1, outputs=y.shape[1], signals=p)


@njit(cache=True, fastmath={"reassoc", "contract"})
def _lag_gram(z: Array, lags: int) -> Array:  # pragma: no cover - compiled
    """Signals (p, N) to the Gram matrix (lags p, lags p)."""
    p, N = z.shape
    T = N - lags + 1
    G = np.empty((lags * p, lags * p))
    for j in range(lags):
        for a in range(p):
            for b in range(p):
                total = 0.0
                for t in range(T):
                    total += z[a, t] * z[b, t + j]
                G[a, j * p + b] = total
    for i in range(1, lags):
        for j in range(i, lags):
            for a in range(p):
                for b in range(p):
                    edge = z[a, T + i - 1] * z[b, T + j - 1] - z[a, i - 1] * z[b, j - 1]
                    G[i * p + a, j * p + b] = G[(i - 1) * p + a, (j - 1) * p + b] + edge
    for row in range(lags * p):
        for column in range(row):
            G[row, column] = G[column, row]
    return G


def identify(
    gram: LagGram, dt: float = 1.0, *, order: int | None = None, method: Method = "cva"
) -> Identified:
    """A model from a Gram matrix; ``order`` None: the one that minimises :func:`order_criterion`.

    Raises:
        LogError: an order that the lags cannot carry, or a signal that is zero throughout.
    """
    p, outputs = gram.signals, gram.outputs
    r, m = gram.gram.shape[0] // (2 * p), p - outputs
    if order is not None and not 1 <= order <= outputs * (r - 1):
        raise LogError(f"order {order}: a horizon of {r} samples carries orders 1 … {outputs * (r - 1)}")
    scale = np.sqrt(np.diag(gram.gram).reshape(2 * r, p).mean(axis=0) / gram.count)
    if not (scale > 0.0).all():
        raise LogError(
            f"subspace identification: signal {int(np.argmin(scale)) + 1} of [y, u] is zero throughout"
        )
    place, rows = _places(r, p, outputs)
    L = _lq(gram.gram, 1.0 / np.tile(scale * np.sqrt(gram.count), 2 * r), rows)
    S, projection = _project(L, r * m, r * p, method == "cva" or order is None, method == "cva")
    past = slice(r * m, r * m + r * p)
    weighted = projection
    if method == "n4sid":
        weighted = _right_divide(projection, L[past, past]) @ L[past, : past.stop]
    U, s = _canonical(weighted) if method == "cva" else np.linalg.svd(weighted, full_matrices=False)[:2]
    criterion = None
    if order is None:
        canonical = s if method == "cva" else np.linalg.svd(_left_divide(S, projection), compute_uv=False)
        criterion = order_criterion(np.asarray(canonical[: outputs * (r - 1)]), gram.count, outputs, m)
        order = 1 + int(np.argmin(criterion[1:]))
    if not s[order - 1] > 0.0:
        raise LogError(f"subspace identification: the signals do not excite a model of order {order}")
    root, U = np.sqrt(s[:order]), U[:, :order]
    observability = (S @ U if method == "cva" else U) * root
    to_past = (U / root).T @ projection
    A, B, C, D, K, R = _realise(L, place, observability, to_past, outputs, p, r, past.start)
    y, u = scale[:outputs], scale[outputs:]
    model = StateSpace(
        A=A, B=B / u, C=y[:, None] * C, D=y[:, None] * D / u, K=K / y, R=y[:, None] * R * y, dt=dt
    )
    return Identified(model=model, order=order, singular_values=s, criterion=criterion)


def order_criterion(canonical: Array, count: int, outputs: int, inputs: int) -> Array:
    """``SVC(n) = sigma_(n+1)^2 + d(n) ln T / T`` for n = 0, 1, ..., with d(n) = n (2 l + m) parameters,
    from the canonical correlations of CVA (D. Bauer, Automatica 37, 2001, 1561-1573).

    >>> int(np.argmin(order_criterion(np.array([0.99, 0.9, 0.05, 0.04]), 1000, 1, 1)))
    2
    """
    n = np.arange(len(canonical) + 1)
    following = np.append(canonical, 0.0) ** 2
    return np.asarray(following + n * (2 * outputs + inputs) * np.log(count) / count)


def _canonical(M: Array) -> tuple[Array, Array]:
    """Left singular vectors and singular values of M, which are at most 1, so that their squares do as
    well and take half the time; what rounding leaves of a 0 is 0."""
    square, U = np.linalg.eigh(M @ M.T)
    return U[:, ::-1], np.sqrt(np.where(square > SINGULAR, square, 0.0))[::-1]


@cache
def _places(r: int, p: int, outputs: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each row of phi is in L, and which row of phi is there: future u, past, future y."""
    lag, channel = np.divmod(np.arange(2 * r * p), p)
    rows = np.argsort(np.where(lag < r, 1, np.where(channel < outputs, 2, 0)), kind="stable")
    return np.argsort(rows), rows


@njit(cache=True)
def _lq(gram: Array, scale: Array, rows: NDArray[np.int64]) -> Array:  # pragma: no cover - compiled
    """L of the scaled signals."""
    G = np.empty(gram.shape)
    for i in range(len(G)):
        for j in range(len(G)):
            G[i, j] = gram[rows[i], rows[j]] * scale[rows[i]] * scale[rows[j]]
    return _factor(G)


@njit(cache=True)
def _project(
    L: Array, a: int, width: int, with_S: bool, divide: bool
) -> tuple[Array, Array]:  # pragma: no cover - compiled
    """S (the unit matrix where it is not wanted), and L32 or inv(S) L32; L22 begins at row a."""
    b = a + width
    L32, L33 = np.ascontiguousarray(L[b:, a:b]), np.ascontiguousarray(L[b:, b:])
    S = _factor(L32 @ L32.T + L33 @ L33.T) if with_S else np.eye(len(L32))
    return S, _left_divide(S, L32) if divide else L32


@njit(cache=True, fastmath={"reassoc", "contract"})
def _factor(G: Array) -> Array:  # pragma: no cover - compiled
    """Lower triangular L with ``L L' = G``, Cholesky's; G has ones on its diagonal, or nearly.

    A row that depends on those before it, as lags without noise do, adds no direction: its pivot is 0.
    """
    n = len(G)
    L = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            total = G[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                L[j, j] = np.sqrt(total) if total > SINGULAR * G[j, j] else 0.0
            elif L[j, j] > 0.0:
                L[i, j] = total / L[j, j]
    return L


@njit(cache=True)
def _left_divide(L: Array, M: Array) -> Array:  # pragma: no cover - compiled
    """X of ``L X = M`` for a factor L; rows without a pivot are 0."""
    X = np.zeros(M.shape)
    for i in range(len(L)):
        if L[i, i] > 0.0:
            X[i] = M[i]
            for k in range(i):
                X[i] -= L[i, k] * X[k]
            X[i] /= L[i, i]
    return X


@njit(cache=True)
def _right_divide(M: Array, L: Array) -> Array:  # pragma: no cover - compiled
    """X of ``X L = M`` for a factor L; columns without a pivot are 0."""
    X = np.zeros(M.shape)
    for i in range(len(M)):
        for j in range(len(L) - 1, -1, -1):
            if L[j, j] > 0.0:
                total = M[i, j]
                for k in range(j + 1, len(L)):
                    total -= X[i, k] * L[k, j]
                X[i, j] = total / L[j, j]
    return X


@njit(cache=True)
def _least_squares(Y: Array, X: Array) -> Array:  # pragma: no cover - compiled
    """Theta that minimises ``|Y - Theta X|``."""
    F = _factor(X @ X.T)
    return _right_divide(np.ascontiguousarray(_left_divide(F, X @ Y.T).T), F)


@njit(cache=True)
def _realise(
    L: Array,
    place: NDArray[np.int64],
    observability: Array,
    to_past: Array,
    outputs: int,
    p: int,
    r: int,
    a: int,
) -> tuple[Array, Array, Array, Array, Array, Array]:  # pragma: no cover - compiled
    """A, B, C, D, K, R of the scaled signals: A and C by shift invariance, the others by least squares,
    with all signals as coordinates in the orthonormal basis of the LQ."""
    n = observability.shape[1]
    states = _right_divide(to_past, np.ascontiguousarray(L[a : a + r * p, a : a + r * p]))
    C = observability[:outputs].copy()
    above = np.ascontiguousarray(observability[:-outputs].T)
    A = np.ascontiguousarray(_least_squares(np.ascontiguousarray(observability[outputs:].T), above).T)
    now, following = states @ L[place[: r * p]], states @ L[place[p : (r + 1) * p]]
    y, u = L[place[r * p : r * p + outputs]], L[place[r * p + outputs : (r + 1) * p]]
    rest = np.concatenate((following - A @ now, y - C @ now))
    BD = _least_squares(rest, u)
    left = rest - BD @ u
    w, e = np.ascontiguousarray(left[:n]), np.ascontiguousarray(left[n:])
    return A, BD[:n].copy(), C, BD[n:].copy(), _least_squares(w, e), e @ e.T
