"""Lags: the candidate regressors of a log, without ever building the whole matrix.

A log is cut into segments without gaps or missing values, and a window of lags never reaches across two of
them, nor across two logs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
GAP_STEPS = 1.5


def segments(time: Array, values: Array, step: float | None = None) -> list[Array]:
    """The stretches of ``values``, shape (N, variables), that are complete and without a gap in ``time``.

    A gap is more than 1.5 ``step``, by default the median step.

    >>> time, values = np.array([0.0, 1, 2, 9, 10]), np.array([[0.0], [1], [np.nan], [3], [4]])
    >>> [s.ravel().tolist() for s in segments(time, values)]
    [[0.0, 1.0], [3.0, 4.0]]
    """
    complete = np.isfinite(values).all(axis=1)
    if not complete.any():
        return []
    step = float(np.median(np.diff(time))) if step is None and len(time) > 1 else step
    late = np.diff(time, prepend=time[0]) > GAP_STEPS * (step or np.inf)
    run = np.cumsum(late | ~complete)
    starts = np.flatnonzero(np.diff(run[complete], prepend=-1))
    return np.split(values[complete], starts[1:])


@dataclass(frozen=True, eq=False)
class Lagged:
    """The rows (candidates | target) of ``segments``, each shape (N, variables): candidate c is variable
    ``variable[c]`` at lag ``lag[c]``; ``target`` is the variable at lag 0 that is to be explained."""

    segments: Sequence[Array]
    variable: Ints
    lag: Ints
    target: int

    @property
    def reach(self) -> int:
        """Largest lag."""
        return int(self.lag.max(initial=0))

    @property
    def rows(self) -> int:
        return sum(max(len(s) - self.reach, 0) for s in self.segments)

    @property
    def _columns(self) -> tuple[Ints, Ints]:
        return np.append(self.variable, self.target), np.append(self.lag, 0)

    def blocks(self, rows: int) -> Iterator[Array]:
        """Consecutive blocks of at most ``rows`` rows, shape (rows, candidates + 1), last the target. One
        buffer is used for all of them."""
        variable, lag = self._columns
        buffer = np.empty((min(rows, max(self.rows, 1)), len(lag)))
        for z in self.segments:
            for start in range(self.reach, len(z), rows):
                part = buffer[: min(rows, len(z) - start)]
                _fill(z, variable, lag, np.arange(start, start + len(part)), part)
                yield part

    def take(self, which: Ints) -> Array:
        """The rows of the given numbers, ascending, shape (len(which), candidates + 1)."""
        variable, lag = self._columns
        out = np.empty((len(which), len(lag)))
        first = at = 0
        for z in self.segments:
            n = max(len(z) - self.reach, 0)
            last = int(np.searchsorted(which, first + n))
            _fill(z, variable, lag, which[at:last] - first + self.reach, out[at:last])
            first, at = first + n, last
        return out

    def sample(self, most: int, seed: int = 0) -> Array:
        """All rows, or ``most`` of them drawn at random without repetition, in order."""
        if self.rows <= most:
            return self.take(np.arange(self.rows))
        rng = np.random.default_rng(seed)
        return self.take(np.sort(rng.choice(self.rows, most, replace=False)))


@njit(cache=True)
def _fill(z: Array, variable: Ints, lag: Ints, at: Ints, out: Array) -> None:  # pragma: no cover - compiled
    for r in range(len(at)):
        for c in range(len(lag)):
            out[r, c] = z[at[r] - lag[c], variable[c]]
