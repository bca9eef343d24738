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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree, shortest_path
from scipy.spatial.distance import cdist

Array = NDArray[np.float64]
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
    unit = np.zeros(len(S), dtype=np.int32)
    error = [_local_error(S, y, weight)[0]]
    enough = growth.samples_per_parameter * (S.shape[1] + 1)
    closed: set[int] = set()
    while len(error) < growth.nodes and sum(error) > growth.max_error**2 * weight.sum():
        open_regions = [m for m in range(len(error)) if m not in closed]
        if not open_regions:
            break
        worst = max(open_regions, key=lambda m: error[m])
        rows = np.flatnonzero(unit == worst)
        upper = rows[_split(S[rows], weight[rows])]
        lower = np.setdiff1d(rows, upper, assume_unique=True)
        halves = [_local_error(S[part], y[part], weight[part]) for part in (lower, upper)]
        if any(weight[part].sum() < enough for part in (lower, upper)) or any(
            condition > CONDITION_LIMIT for _, condition in halves
        ):
            closed.add(worst)
            continue
        unit[upper] = len(error)
        error[worst] = halves[0][0]
        error.append(halves[1][0])
    nodes = np.stack([np.average(S[unit == m], axis=0, weights=weight[unit == m]) for m in range(len(error))])
    return _organise(nodes, S, y, weight, growth.epochs)


def _split(S: Array, weight: Array) -> NDArray[np.bool_]:
    """Rows of the upper half: two centres 0.8 standard deviations out on the principal axis, two Lloyd
    steps."""
    mean = np.average(S, axis=0, weights=weight)
    values, vectors = np.linalg.eigh(np.cov(S.T, aweights=weight, ddof=0).reshape(S.shape[1], -1))
    reach = 0.8 * np.sqrt(max(values[-1], 0.0)) * vectors[:, -1]
    centres = np.stack([mean - reach, mean + reach])
    for last in (False, False, True):
        upper = np.asarray((S - centres.mean(axis=0)) @ (centres[1] - centres[0]) > 0)
        if last or upper.all() or not upper.any():
            break
        centres = np.stack([np.average(S[part], axis=0, weights=weight[part]) for part in (~upper, upper)])
    return upper


def _local_error(S: Array, y: Array, weight: Array) -> tuple[float, float]:
    """Weighted residual sum of squares of an affine model, and its Gram matrix's condition number."""
    if not len(S):
        return 0.0, np.inf
    mean = np.average(S, axis=0, weights=weight)
    X = np.column_stack([np.ones(len(S)), S - mean])
    G, h = X.T @ (X * weight[:, None]), X.T @ (weight * y)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    condition = float(np.linalg.cond(G * np.outer(scale, scale)))
    theta = np.linalg.lstsq(G, h, rcond=None)[0]
    return float(weight @ (y - X @ theta) ** 2), condition


def _organise(nodes: Array, S: Array, y: Array, weight: Array, epochs: int) -> Partition:
    """The batch updates (4.5) with a neighbourhood that narrows to nothing, then the edges."""
    partition = Partition(nodes, edges(nodes, S))
    for k in range(epochs if len(nodes) > 1 else 0):
        unit = partition.assign(S)
        count = np.bincount(unit, weight, minlength=len(nodes))
        total = np.stack([np.bincount(unit, weight * s, minlength=len(nodes)) for s in S.T], axis=1)
        parts = [unit == m for m in range(len(nodes))]
        rss = np.array([_local_error(S[p], y[p], weight[p])[0] for p in parts])
        rms = np.sqrt(rss / np.maximum(count, 1e-9))
        zeta = rms / rms.max() if rms.max() > 0 else np.ones(len(nodes))
        sigma = 0.5 * (1 - k / epochs)
        h = np.exp(-(partition.distances() ** 2) / (2 * sigma**2))
        goal = (h @ total) / np.maximum(h @ count, 1e-9)[:, None]
        moved = np.where((h @ count > 0)[:, None], zeta[:, None] * (goal - partition.nodes), 0.0)
        partition = Partition(partition.nodes + moved, edges(partition.nodes + moved, S))
    return partition


def edges(nodes: Array, S: Array) -> NDArray[np.int64]:
    """Pairs that are first and second nearest to at least 1 % of a node's samples, and a spanning tree."""
    M = len(nodes)
    if M == 1:
        return np.empty((0, 2), dtype=np.int64)
    apart = cdist(nodes, nodes)
    near = np.argpartition(cdist(S, nodes), 1, axis=1)[:, :2]
    near.sort(axis=1)
    pairs, count = np.unique(near, axis=0, return_counts=True)
    size = np.bincount(near.ravel(), minlength=M)
    joined = pairs[count >= 0.01 * np.minimum(size[pairs[:, 0]], size[pairs[:, 1]])]
    tree = np.sort(np.argwhere(minimum_spanning_tree(csr_array(np.triu(apart))).toarray() > 0), axis=1)
    return np.unique(np.vstack([joined, tree]), axis=0).astype(np.int64)
