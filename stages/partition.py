"""Partition: a growing self-organising map that cuts an operating space into regions.

The regions are the Voronoi cells (4.4) of the map's nodes. The map starts with one node; the node whose
local affine model fits worst is split until a stopping rule of section 4.2.2 holds:

- S1 the root mean square error is at most ``max_error``;
- S2 there are ``nodes`` nodes;
- S3 a split would leave a region with fewer than ``samples_per_parameter`` samples per parameter;
- S4 a split would leave a region whose Gram matrix has a condition number above 1e8 (as printed, the rule
  allows 4.5e23 and never acts).

The batch update (4.5) then moves the nodes a few times, ``xi_m += zeta_m (sum_c h_mc N_c s_c / sum_c h_mc N_c
- xi_m)``, with ``zeta`` the relative modelling error (4.6) and ``h`` the neighbourhood (4.7); the printed
form, with c = m, has h = 1 always. Edges join the two nodes nearest to a sample (Martinetz 1993) and keep the
map connected. No random numbers are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree, shortest_path
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
CONDITION_LIMIT = 1e8
CHUNK = 65536  # rows handled at once: bounds memory


@dataclass(frozen=True, eq=False)
class Partition:
    """``nodes``: centres, shape (M, d). ``edges``: pairs of neighbours, shape (E, 2)."""

    nodes: Array
    edges: NDArray[np.int64]

    def assign(self, S: Array) -> NDArray[np.int32]:
        """Best matching unit (4.8) of each row of ``S``, shape (N, d); -1 where a value is missing.

        >>> Partition(np.array([[0.0], [1.0]]), np.empty((0, 2), dtype=int)).assign(np.array([[0.2], [0.9]]))
        array([0, 1], dtype=int32)
        """
        unit = np.full(len(S), -1, dtype=np.int32)
        half = 0.5 * (self.nodes**2).sum(axis=1)
        for k in range(0, len(S), CHUNK):
            part = S[k : k + CHUNK]
            known = np.isfinite(part).all(axis=1)
            unit[k : k + CHUNK][known] = np.argmin(half - part[known] @ self.nodes.T, axis=1)
        return unit

    def distances(self) -> Array:
        """Number of edges on the shortest path between two nodes (breadth first), shape (M, M)."""
        M = len(self.nodes)
        graph = csr_array((np.ones(len(self.edges)), (self.edges[:, 0], self.edges[:, 1])), shape=(M, M))
        return np.asarray(shortest_path(graph, directed=False, unweighted=True))


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Stopping rules and training of the map; see the module's text."""

    nodes: int = 16
    samples_per_parameter: float = 6.0
    max_error: float = 0.0
    epochs: int = 5
    rows: int = 20_000


def grow(S: Array, y: Array, weight: Array, growth: Growth | None = None) -> Partition:
    """The map of ``S``, shape (N, d), for an output ``y`` and sample weights, both of shape (N,).

    Rows must be complete; of more than ``growth.rows`` rows every n-th is used.
    """
    growth = growth or Growth()
    step = max(1, -(-len(S) // growth.rows))
    S, y, weight = S[::step], y[::step], weight[::step]
    rows = [np.arange(len(S))]
    (first,), _ = _local_errors(S, y, weight, rows)
    error = [float(first)]
    enough = growth.samples_per_parameter * (S.shape[1] + 1)
    closed: set[int] = set()
    while len(error) < growth.nodes and sum(error) > growth.max_error**2 * weight.sum():
        open_regions = [m for m in range(len(error)) if m not in closed]
        if not open_regions:
            break
        worst = max(open_regions, key=lambda m: error[m])
        halves = _split(S, weight, rows[worst])
        rss, condition = _local_errors(S, y, weight, halves)
        if any(weight[half].sum() < enough for half in halves) or (condition > CONDITION_LIMIT).any():
            closed.add(worst)
            continue
        rows[worst], error[worst] = halves[0], float(rss[0])
        rows.append(halves[1])
        error.append(float(rss[1]))
    nodes = np.stack([np.average(S[part], axis=0, weights=weight[part]) for part in rows])
    return _organise(nodes, S, y, weight, growth.epochs)


def _split(S: Array, weight: Array, rows: Ints) -> list[Ints]:
    """Rows of the lower and upper half: two centres 0.8 standard deviations out on the principal axis, two
    Lloyd steps."""
    mean, G, _, _ = _moments(S, np.zeros(len(S)), weight, rows, np.array([0, len(rows)]))
    values, vectors = np.linalg.eigh(G[0, 1:, 1:] / G[0, 0, 0])
    reach = 0.8 * np.sqrt(max(values[-1], 0.0)) * vectors[:, -1]
    upper = _halve(S, weight, rows, np.stack([mean[0] - reach, mean[0] + reach]))
    return [rows[~upper], rows[upper]]


def _local_errors(S: Array, y: Array, weight: Array, regions: Sequence[Ints]) -> tuple[Array, Array]:
    """Of each region (row numbers): weighted residual sum of squares of an affine model, and its Gram
    matrix's condition number (infinite without rows)."""
    ends = np.cumsum([0, *(len(r) for r in regions)])
    _, G, h, yy = _moments(S, y, weight, np.concatenate(list(regions)), ends)
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("mii->mi", G), 1e-300))
    values, vectors = np.linalg.eigh(G * scale[:, :, None] * scale[:, None, :])
    along = np.einsum("mij,mi->mj", vectors, scale * h)
    least = np.finfo(float).eps * G.shape[1] * values[:, -1:]
    used = values > np.maximum(least, 1e-300)
    explained = np.where(used, along**2 / np.where(used, values, 1.0), 0.0).sum(axis=1)
    condition = np.where(
        values[:, 0] > 0, values[:, -1] / np.where(values[:, 0] > 0, values[:, 0], 1.0), np.inf
    )
    return np.maximum(yy - explained, 0.0), condition


def _organise(nodes: Array, S: Array, y: Array, weight: Array, epochs: int) -> Partition:
    """The batch updates (4.5) with a neighbourhood that narrows to nothing, then the edges."""
    M = len(nodes)
    near = _two_nearest(S, nodes)
    partition = Partition(nodes, _joined(nodes, near))
    for k in range(epochs if M > 1 else 0):
        unit = near[:, 0]
        count = np.bincount(unit, weight, minlength=M)
        total = np.stack([np.bincount(unit, weight * s, minlength=M) for s in S.T], axis=1)
        order = np.argsort(unit, kind="stable")
        rss, _ = _local_errors(S, y, weight, np.split(order, np.searchsorted(unit[order], np.arange(1, M))))
        rms = np.sqrt(rss / np.maximum(count, 1e-9))
        zeta = rms / rms.max() if rms.max() > 0 else np.ones(M)
        sigma = 0.5 * (1 - k / epochs)
        h = np.exp(-(partition.distances() ** 2) / (2 * sigma**2))
        goal = (h @ total) / np.maximum(h @ count, 1e-9)[:, None]
        nodes = nodes + np.where((h @ count > 0)[:, None], zeta[:, None] * (goal - nodes), 0.0)
        near = _two_nearest(S, nodes)
        partition = Partition(nodes, _joined(nodes, near))
    return partition


def edges(nodes: Array, S: Array) -> Ints:
    """Pairs that are first and second nearest to at least 1 % of a node's samples, and a spanning tree."""
    return _joined(nodes, _two_nearest(S, nodes))


def _joined(nodes: Array, near: Ints) -> Ints:
    M = len(nodes)
    if M == 1:
        return np.empty((0, 2), dtype=np.int64)
    pairs = np.bincount(near.min(axis=1) * M + near.max(axis=1), minlength=M * M).reshape(M, M)
    size = pairs.sum(axis=0) + pairs.sum(axis=1)
    joined = (pairs > 0) & (pairs >= 0.01 * np.minimum(size[:, None], size))
    tree = minimum_spanning_tree(csr_array(np.triu(cdist(nodes, nodes)))).toarray() > 0
    return np.argwhere(joined | np.triu(tree | tree.T)).astype(np.int64)


def _two_nearest(S: Array, nodes: Array) -> Ints:
    """The nearest and second nearest node of each row, shape (N, 2)."""
    return _two_least(0.5 * (nodes**2).sum(axis=1) - S @ nodes.T)


@njit(cache=True)
def _two_least(x: Array) -> Ints:  # pragma: no cover - compiled
    out = np.zeros((len(x), 2), dtype=np.int64)
    for r in range(len(x)):
        first = second = np.inf
        for m in range(x.shape[1]):
            if x[r, m] < first:
                second, out[r, 1] = first, out[r, 0]
                first, out[r, 0] = x[r, m], m
            elif x[r, m] < second:
                second, out[r, 1] = x[r, m], m
    return out


@njit(cache=True)
def _moments(
    S: Array, y: Array, weight: Array, rows: Ints, ends: Ints
) -> tuple[Array, Array, Array, Array]:  # pragma: no cover - compiled
    """Of region m, rows[ends[m]:ends[m + 1]]: weighted mean, and X'WX, X'Wy, y'Wy of X = [1, s - mean] and y
    less its mean."""
    M, d = len(ends) - 1, S.shape[1]
    mean, G, h, yy = np.zeros((M, d)), np.zeros((M, d + 1, d + 1)), np.zeros((M, d + 1)), np.zeros(M)
    x = np.ones(d + 1)
    for m in range(M):
        part = rows[ends[m] : ends[m + 1]]
        mass = level = 0.0
        for r in part:
            mass += weight[r]
            level += weight[r] * y[r]
            for j in range(d):
                mean[m, j] += weight[r] * S[r, j]
        for j in range(d):
            mean[m, j] /= max(mass, 1e-300)
        level /= max(mass, 1e-300)
        for r in part:
            for j in range(d):
                x[j + 1] = S[r, j] - mean[m, j]
            for i in range(d + 1):
                for j in range(i + 1):
                    G[m, i, j] += weight[r] * x[i] * x[j]
                h[m, i] += weight[r] * x[i] * (y[r] - level)
            yy[m] += weight[r] * (y[r] - level) ** 2
        for i in range(d + 1):
            for j in range(i):
                G[m, j, i] = G[m, i, j]
    return mean, G, h, yy


@njit(cache=True)
def _halve(
    S: Array, weight: Array, rows: Ints, two: Array
) -> NDArray[np.bool_]:  # pragma: no cover - compiled
    """Which rows are nearer to the second of two centres, after two Lloyd steps."""
    N, d = len(rows), S.shape[1]
    upper = np.zeros(N, dtype=np.bool_)
    for step in range(3):
        mass, sums, count = np.zeros(2), np.zeros((2, d)), 0
        for i in range(N):
            side = 0.0
            for j in range(d):
                side += (S[rows[i], j] - 0.5 * (two[0, j] + two[1, j])) * (two[1, j] - two[0, j])
            upper[i] = side > 0
            k = 1 if side > 0 else 0
            count += k
            mass[k] += weight[rows[i]]
            for j in range(d):
                sums[k, j] += weight[rows[i]] * S[rows[i], j]
        if step == 2 or count == 0 or count == N:
            break
        for k in range(2):
            for j in range(d):
                two[k, j] = sums[k, j] / mass[k]
    return upper
