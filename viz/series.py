"""Series made ready to be drawn: gaps become breaks, long series envelopes, states their changes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Log

Array = NDArray[np.float64]

TRUTH = "truth."
"""Begins the names of signals that a simulator knows and no engine has."""
GAP_STEPS = 5.0
"""A step this many times longer than nearly all others is a gap."""


def numbers(values: pl.Series) -> Array:
    """A numeric column as float64, shape (rows,), missing values NaN.

    >>> numbers(pl.Series([1, None, 3])).tolist()
    [1.0, nan, 3.0]
    """
    if values.null_count() or not values.dtype.is_numeric():
        values = values.cast(pl.Float64).fill_null(float("nan"))
    return np.asarray(values.to_numpy(), dtype=np.float64)


def at_times(log: Log, name: str, time: Array) -> Array:
    """A signal at other times, linear between its samples; NaN before and after them, or where it is none."""
    if name not in log.signals:
        return np.full(time.size, np.nan)
    known, values = log.group_of(name).time, log.values(name)
    order = np.argsort(known, kind="stable")
    order = order[np.isfinite(values[order])]
    if not order.size:
        return np.full(time.size, np.nan)
    return np.interp(time, known[order], values[order], left=np.nan, right=np.nan)


def usual_step(time: Array) -> float:
    """The step in s that nine of ten do not exceed, repeated time stamps aside; 0 where there is none."""
    steps = np.diff(time)
    steps = steps[steps > 0]
    return float(np.quantile(steps, 0.9)) if steps.size else 0.0


def gap_rows(time: Array) -> NDArray[np.intp]:
    """Rows after which rows are missing, shape (gaps,); ``time`` rises.

    >>> gap_rows(np.array([0.0, 0.1, 0.2, 5.0, 5.1, 5.2, 5.3, 5.4, 5.5, 5.6, 5.7, 5.8])).tolist()
    [2]
    """
    return np.flatnonzero(np.diff(time) > GAP_STEPS * usual_step(time))


def break_at_gaps(time: Array, values: Array) -> tuple[Array, Array]:
    """A row of NaN one usual step after each row that a gap follows, so that no line bridges the gap.

    ``time`` has shape (n,) and rises, ``values`` (n, k); both are returned with one row more per gap.
    """
    rows = gap_rows(time)
    times = np.insert(time, rows + 1, time[rows] + usual_step(time))
    return times, np.insert(values, rows + 1, np.nan, axis=0)


def envelope(time: Array, values: Array, points: int) -> tuple[Array, Array]:
    """The least and greatest value of each of about ``points / 2`` buckets, in their order of appearance.

    Peaks keep their height and stay in their bucket. Rows without any value get buckets of their own, so
    breaks stay breaks. Shapes (n,), (n, k) -> (m,), (m, k), m near ``points``; short series pass unchanged.
    """
    if time.size <= points:
        return time, values
    starts = buckets(np.asarray(np.isnan(values).all(axis=1)), points)
    lines = [extremes(column, starts) for column in values.T]
    return time[bucket_rows(starts, time.size)], np.stack(lines, axis=1)


def buckets(empty: NDArray[np.bool_], points: int) -> NDArray[np.intp]:
    """First rows of about ``points / 2`` buckets, and of each stretch of rows that are ``empty`` or not."""
    width = -(-2 * empty.size // points)
    return np.union1d(np.arange(0, empty.size, width), changes(empty))


def bucket_rows(starts: NDArray[np.intp], rows: int) -> NDArray[np.intp]:
    """First and last row of each bucket, once where they are one, shape (m,)."""
    ends = np.append(starts[1:], rows) - 1
    return np.stack([starts, ends], axis=1).ravel()[_kept(starts, ends)]


def extremes(values: Array, starts: NDArray[np.intp]) -> Array:
    """Least and greatest of ``values``, shape (n,), in each bucket in their order of appearance, at
    :func:`bucket_rows`, shape (m,)."""
    ends = np.append(starts[1:], values.size) - 1
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    rising = _first(values, low, starts, ends) <= _first(values, high, starts, ends)
    pairs = np.stack([np.where(rising, low, high), np.where(rising, high, low)], axis=1)
    return np.asarray(pairs.ravel()[_kept(starts, ends)])


def _first(values: Array, sought: Array, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> NDArray[Any]:
    """The first row of each bucket that holds what is ``sought`` there."""
    rows = np.flatnonzero(values == np.repeat(sought, ends - starts + 1))
    return np.append(rows, values.size)[np.searchsorted(rows, starts)]


def _kept(starts: NDArray[np.intp], ends: NDArray[np.intp]) -> NDArray[np.bool_]:
    return np.stack([np.ones_like(starts, dtype=bool), ends > starts], axis=1).ravel()


def changes(states: NDArray[Any]) -> NDArray[np.intp]:
    """Rows at which the state differs from the row before, the first row included.

    >>> changes(np.array(["a", "a", "b", "a"])).tolist()
    [0, 2, 3]
    """
    if not len(states):
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero(np.append(True, states[1:] != states[:-1]))


def lane(time: Array, states: NDArray[Any]) -> tuple[Array, list[str]]:
    """Times and names of the states' changes; gaps and the end of the log end a state (``""``).

    ``time`` has shape (n,) and rises, ``states`` (n,) are text, ``""`` where there is none.
    """
    rows = gap_rows(time)
    step = usual_step(time)
    full = np.insert(states.astype(object), rows + 1, "")
    times = np.insert(time, rows + 1, time[rows] + step)
    at = changes(full)
    ends = [] if not time.size else [time[-1] + (step or 1.0)]
    return np.append(times[at], ends), [*full[at].tolist(), *("" for _ in ends)]


def spans(time: Array, active: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Start and end in s of each run of true rows; a run ends at the first false row or the last row.

    >>> spans(np.arange(5.0), np.array([False, True, True, False, True]))
    [(1.0, 3.0), (4.0, 4.0)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(np.int8), [0]])))
    last = time.size - 1
    return [(float(time[a]), float(time[min(b, last)])) for a, b in edges.reshape(-1, 2)]


def union(windows: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Windows in order of time, those that overlap or touch made one.

    >>> union([(5.0, 9.0), (1.0, 3.0), (2.0, 4.0)])
    [(1.0, 4.0), (5.0, 9.0)]
    """
    joined: list[tuple[float, float]] = []
    for start, end in sorted(windows):
        if joined and start <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined


def tick_step(low: float, high: float) -> float:
    """A step of 1, 2 or 5 times a power of ten that gives four to ten ticks.

    >>> tick_step(800.0, 4300.0)
    500.0
    """
    rough = (high - low) / 8.0
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * min((m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough), default=10.0))


def limits(low: float, high: float) -> tuple[float, float]:
    """``low`` and ``high`` widened to whole ticks, and to something where they hardly differ.

    >>> limits(812.0, 4290.0)
    (500.0, 4500.0)
    """
    if not np.isfinite(high - low) or max(abs(low), abs(high)) > 1e12:
        return low, high
    if high - low < 1e-9 * max(abs(low), abs(high), 1.0):
        low, high = low - 0.5, high + 0.5
    step = tick_step(low, high)
    return float(np.floor(low / step) * step), float(np.ceil(high / step) * step)
