"""The rows of a group as they are drawn: in order, broken at gaps, long groups as envelopes.

They are the same for all signals of the group, so that these share their time stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ingest.log import Group
from viz.series import Array, bucket_rows, buckets, extremes, gap_rows, numbers, usual_step


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """How a long group is drawn: as an envelope of about ``points`` points, and as it is inside ``windows``
    (s)."""

    points: int
    windows: tuple[tuple[float, float], ...] = ()


def in_order(group: Group) -> tuple[Array, NDArray[np.intp]]:
    """Rising time stamps of a group and the rows they come from; what is not finite is left out."""
    rows = np.argsort(group.time, kind="stable")
    rows = rows[np.isfinite(group.time[rows])]
    return group.time[rows], rows


class Raster:
    """The rows at which the signals ``names`` of ``group`` are drawn, reduced as ``how`` says.

    ``time``: their time stamps, shape (m,), rising.
    """

    def __init__(self, group: Group, names: Sequence[str], how: Reduction | None = None) -> None:
        self.group = group
        time, order = in_order(group)
        self._order = slice(None) if np.array_equal(order, np.arange(group.frame.height)) else order
        self._gaps = gap_rows(time)
        time = np.insert(time, self._gaps + 1, time[self._gaps] + usual_step(time))
        self._parts: list[tuple[slice, NDArray[np.intp] | None]] = [(slice(0, time.size), None)]
        if how is not None and time.size > how.points:
            self._parts = self._reduced(time, self._empty(names, time.size), how)
        self.time = np.concatenate(
            [t if s is None else t[bucket_rows(s, t.size)] for p, s in self._parts for t in [time[p]]]
        )

    def values(self, name: str) -> Array:
        """A signal at these rows, shape (m,); NaN where it has no value."""
        whole = self._whole(name)
        return np.concatenate(
            [v if s is None else extremes(v, s) for p, s in self._parts for v in [whole[p]]]
        )

    def _whole(self, name: str) -> Array:
        column = numbers(self.group.frame[name])[self._order]
        return np.insert(column, self._gaps + 1, np.nan) if self._gaps.size else column

    def _empty(self, names: Sequence[str], rows: int) -> NDArray[np.bool_]:
        """The rows without any value."""
        empty = np.ones(rows, dtype=bool)
        for name in names:
            if not empty.any():
                break
            empty &= np.isnan(self._whole(name))
        return empty

    def _reduced(
        self, time: Array, empty: NDArray[np.bool_], how: Reduction
    ) -> list[tuple[slice, NDArray[np.intp] | None]]:
        """Stretches of rows with the first rows of their buckets, or as they are inside the windows."""
        edges = [0, *np.searchsorted(time, np.array(how.windows).ravel()).tolist(), time.size]
        parts: list[tuple[slice, NDArray[np.intp] | None]] = []
        for i, (start, end) in enumerate(pairwise(edges)):
            points = max(2, round(how.points * (end - start) / time.size))
            reduce = i % 2 == 0 and end - start > points
            part = slice(start, end)
            parts.append((part, buckets(empty[part], points) if reduce else None))
        return parts


def curves(group: Group, names: Sequence[str], how: Reduction | None = None) -> tuple[Array, Array]:
    """Time stamps (m,) and values (m, k) to draw: in order, broken at gaps, reduced as ``how`` says."""
    raster = Raster(group, names, how)
    return raster.time, np.stack([raster.values(name) for name in names], axis=1)
