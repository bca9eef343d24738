"""Exhaustive search: every legal gene of a common partition, so that the optimum is proven.

The genes are walked depth first, variable by variable, and each step adds one regressor: a step from a prefix
of d regressors extends the Cholesky factor of every region by one row, for those columns only that may still
follow, and shares everything else with its relatives. The walk costs nothing per row of data.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.criteria import Score
from stages.genes import Space
from stages.gram import DEPENDENT, Gram
from stages.search import Found

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
LARGEST = 50_000_000  # genes: beyond, the table alone takes gigabytes


def exhaustive(space: Space, gram: Gram, score: Score, shown: int = 50) -> Found:
    """The proven optimum of ``score``.

    Raises:
        RecipeError: the space is too large to be walked.
    """
    f = score(weighted_rss(space, gram, score.weight), space.counts)
    few = np.argpartition(f, min(shown, len(f)) - 1)[:shown]
    best = tuple((int(g), float(f[g])) for g in few[np.argsort(f[few], kind="stable")])
    return Found(best[0][0], best, space.size, (best[0][1],), optimal=True)


def weighted_rss(space: Space, gram: Gram, weight: Array) -> Array:
    """``sum_m weight_m RSS_m`` of every gene by its number, shape (space.size,).

    Raises:
        RecipeError: the space is too large to be walked.
    """
    if space.size > LARGEST:
        raise RecipeError(
            f"{space.size:.3g} genes are too many to search exhaustively (at most {LARGEST:.0e}); lower "
            "--na-max, --nb-max or --nk-max, name fewer inputs, or use --search coordinate"
        )
    blocks = space.blocks
    table = np.array(
        [(b.first, b.chains, b.length, b.fixed, s) for b, s in zip(blocks, space.strides, strict=True)],
        dtype=np.int64,
    )
    K, M = gram.G.shape[0] - 1, gram.G.shape[2]
    depth = sum(b.length for b in blocks)
    V = np.empty((depth, K + 1, M))
    left = np.empty((depth + 1, M))
    left[0] = gram.G[K, K]
    out = np.empty(space.size)
    _walk(0, 0, 0, table, gram.G, weight, V, left, out)
    return out


@njit(cache=True)
def _walk(
    b: int, d: int, gene: int, blocks: Ints, G: Array, weight: Array, V: Array, left: Array, out: Array
) -> None:  # pragma: no cover - compiled
    """All genes whose first ``b`` blocks are chosen, with ``d`` regressors so far."""
    M = G.shape[2]
    if b == blocks.shape[0]:
        total = 0.0
        for m in range(M):
            total += weight[m] * left[d, m]
        out[gene] = total
        return
    first, chains, length, fixed, stride = blocks[b]
    if not fixed:
        _walk(b + 1, d, gene, blocks, G, weight, V, left, out)
    following = first + chains + length - 1
    option = 1 - fixed
    for chain in range(chains):
        for j in range(length):
            _add(first + chain + j, d + j, first + chain + length, following, G, V, left)
            _walk(b + 1, d + j + 1, gene + stride * option, blocks, G, weight, V, left, out)
            option += 1


@njit(cache=True, fastmath=True)
def _add(
    p: int, d: int, end: int, following: int, G: Array, V: Array, left: Array
) -> None:  # pragma: no cover - compiled
    """Row d of the factors: regressor ``p``, for the rest of its chain and all later blocks."""
    K, M = G.shape[0] - 1, G.shape[2]
    root = V[d, p]
    for m in range(M):
        root[m] = G[p, p, m]
    for i in range(d):
        for m in range(M):
            root[m] -= V[i, p, m] * V[i, p, m]
    for m in range(M):
        root[m] = 1.0 / np.sqrt(root[m]) if root[m] > DEPENDENT * G[p, p, m] else 0.0
    for c in range(p + 1, K + 1):
        if end <= c < following:
            continue
        row = V[d, c]
        for m in range(M):
            row[m] = G[p, c, m]
        for i in range(d):
            for m in range(M):
                row[m] -= V[i, p, m] * V[i, c, m]
        for m in range(M):
            row[m] *= root[m]
    for m in range(M):
        left[d + 1, m] = max(left[d, m] - V[d, K, m] * V[d, K, m], 0.0)
