"""The refined grid of sizes: between two sizes of a hypothesis, residuals are interpolated linearly."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.hypotheses import DRIFT_PRIOR, Hypothesis

Array = NDArray[np.float64]


class Grid(NamedTuple):
    """The refined grid: for each of its points the points computed on either side and the share of the right
    one; points and sizes of each fault in order, the log as it is among them where that is size 0, and their
    number; the log prior of each point as a healthy one, -inf for the faults'."""

    left: NDArray[np.uint64]  # unsigned: the compiler need not look for what is counted from the end
    right: NDArray[np.uint64]
    share: Array
    points: NDArray[np.int64]
    sizes: Array
    counts: NDArray[np.int64]
    prior: Array


def refined_grid(
    hypotheses: Sequence[Hypothesis], evaluated: Sequence[Sequence[float]], drifts: int, between: int
) -> Grid:
    """The grid of points as :class:`stages.hypotheses.Points` orders them, ``drifts`` of which are a healthy
    system's, with ``between - 1`` further sizes between two. Where none is ``evaluated``, the hypothesis is
    the log as it is at any size."""
    healthy = 1 + drifts * len(DRIFT_PRIOR)
    left, right, share = list(range(healthy)), list(range(healthy)), [0.0] * healthy
    grids: list[list[tuple[float, int]]] = []
    start = healthy
    for h, some in zip(hypotheses, evaluated, strict=True):
        if not some:
            grids.append([(h.sizes[0], 0), (h.sizes[-1], 0)])
            continue
        computed = [*zip(h.sizes, range(start, start + len(h.sizes)), strict=True)]
        computed = sorted([(0.0, 0), *computed]) if h.from_zero else computed
        start += len(h.sizes)
        grid = []
        for (x, a), (y, b) in pairwise([*computed, computed[-1]]):
            for k in range(between if b != a else 1):
                if a == 0 and k == 0:
                    grid.append((0.0, 0))
                    continue
                grid.append((x + (y - x) * k / between, len(left)))
                left.append(a)
                right.append(b)
                share.append(k / between)
        grids.append(grid)
    widest = max(len(grid) for grid in grids)
    points, sizes = np.full((len(grids), widest), -1), np.zeros((len(grids), widest))
    for i, grid in enumerate(grids):
        sizes[i, : len(grid)], points[i, : len(grid)] = zip(*grid, strict=True)
    prior = np.full(len(left), -np.inf)
    plain = 1.0 - sum(DRIFT_PRIOR) if drifts else 1.0
    prior[:healthy] = np.log([plain, *np.tile(DRIFT_PRIOR, drifts) / max(drifts, 1)])
    counts = np.array([len(grid) for grid in grids])
    sides = np.array(left, dtype=np.uint64), np.array(right, dtype=np.uint64)
    return Grid(*sides, np.array(share), points, sizes, counts, prior)
