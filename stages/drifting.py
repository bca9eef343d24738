"""Drifting: where a series of drives has moved, from one number a drive, such as a residual's mean.

The noise s is that of successive differences, their upper quartile ``q_75 |x_i - x_{i-1}| / (1.15 sqrt 2)``,
which a few steps do not widen. Segments minimise ``sum_i ((x_i - mean of its segment) / s)^2 + penalty`` a
segment, exactly, by dynamic programming (Jackson et al. 2005); the penalty is ``FACTOR ln n``, so that of a
hundred series without a change few are cut. The cusum says when it would have been noticed as the drives
came: from the drive ``REFERENCE`` on, ``c = max(0, c + (x - m) / s - K)`` to either side, until it exceeds H.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FACTOR, SHORTEST = 8.0, 2  # drives in a segment
REFERENCE, K, H = 10, 0.5, 10.0


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Drives ``first`` to ``last`` (of those with a value) with the mean ``level``."""

    first: int
    last: int
    level: float


@dataclass(frozen=True, kw_only=True)
class Drift:
    """``noise`` between drives, the segments, and at which drive the cusum noticed a change, if it did."""

    noise: float
    segments: tuple[Segment, ...]
    noticed: int | None

    @property
    def moved(self) -> float:
        """From the first segment's level to the last one's."""
        return self.segments[-1].level - self.segments[0].level if self.segments else 0.0


def drift_of(x: Array, least: float = 1e-12) -> Drift:
    """The drift in a series (drives,); missing values do not count. ``least``: noise that there is anyway.

    >>> x = np.random.default_rng(0).normal(size=60); x[30:] += 4
    >>> [(s.first, s.last) for s in drift_of(x).segments]
    [(0, 29), (30, 59)]
    """
    known = np.flatnonzero(np.isfinite(x))
    y = x[known]
    if len(y) < 2 * SHORTEST:
        return Drift(noise=np.nan, segments=_as_one(known, y), noticed=None)
    noise = max(float(np.quantile(np.abs(np.diff(y)), 0.75) / (1.1503 * np.sqrt(2))), least)
    cuts = _cuts(y / noise, FACTOR * np.log(len(y)))
    edges = [0, *cuts, len(y)]
    segments = tuple(
        Segment(first=int(known[a]), last=int(known[b - 1]), level=float(y[a:b].mean()))
        for a, b in pairwise(edges)
    )
    noticed = _cusum(y, noise)
    return Drift(noise=noise, segments=segments, noticed=None if noticed is None else int(known[noticed]))


def _as_one(known: NDArray[np.int64], y: Array) -> tuple[Segment, ...]:
    if not len(y):
        return ()
    return (Segment(first=int(known[0]), last=int(known[-1]), level=float(y.mean())),)


def _cuts(y: Array, penalty: float) -> list[int]:
    """Where segments begin, but for the first: the exact optimum by dynamic programming, O(n^2)."""
    n = len(y)
    s1, s2 = np.append(0, np.cumsum(y)), np.append(0, np.cumsum(y**2))
    best, before = np.full(n + 1, np.inf), np.zeros(n + 1, dtype=int)
    best[0] = -penalty
    for end in range(SHORTEST, n + 1):
        start = np.arange(0, end - SHORTEST + 1)
        cost = s2[end] - s2[start] - (s1[end] - s1[start]) ** 2 / (end - start)
        total = best[start] + cost + penalty
        before[end] = start[np.argmin(total)]
        best[end] = total.min()
    cuts, at = [], n
    while before[at] > 0:
        at = int(before[at])
        cuts.append(at)
    return cuts[::-1]


def _cusum(y: Array, noise: float) -> int | None:
    """The drive at which the cusum exceeds H; the reference is the median of the first ones."""
    if len(y) <= REFERENCE:
        return None
    start = y[:REFERENCE]
    up = down = 0.0
    slack = K + 1.25 / np.sqrt(REFERENCE)  # the reference's own error
    for i in range(REFERENCE, len(y)):
        z = (y[i] - float(np.median(start))) / noise
        up, down = max(0.0, up + z - slack), max(0.0, down - z - slack)
        if max(up, down) > H:
            return i
    return None
