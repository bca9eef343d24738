"""Align: bring the signals of a log onto one raster, without inventing a sample.

The only place that resamples. With ``raster_s = 0`` the rows are the time stamps of the first signal's own
group, regular or not; else they are the multiples of ``raster_s``. The value of a signal at row ``t`` is

1. with its own group's stamps: the sample itself;
2. going down (two samples or more in ``(t - raster_s, t]``): their mean, or the last one of a state;
3. else: linear interpolation between the neighbours, or the last sample of a state or counter.

It is missing outside the group's span and where the neighbours (or the last sample of a state) lie more than
``max_gap_s`` apart: nothing is extrapolated. A row without any value is left out, so gaps stay gaps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import TIME, Group, Log, Signal
from stages.stage import ANALYSIS

Duplicates = Literal["last", "first", "mean"]


@dataclass(frozen=True)
class AlignState:
    """Rows of each group still needed, and the time of the last row that came out."""

    kept: Mapping[str, pl.DataFrame] = field(default_factory=dict)
    done: float = -np.inf


@dataclass(frozen=True, kw_only=True)
class Align:
    """Settings: ``signals`` (all must be in the log) and ``optional`` ones (missing throughout where it lacks
    them), ``raster_s``, ``max_gap_s``, and which of several samples with one time stamp counts.

    Raises:
        RecipeError: no signals, or a negative raster or gap.
        LogError: a signal is not in the log, or is not numeric.
    """

    version: ClassVar[str] = "2"
    signals: tuple[str, ...]
    optional: tuple[str, ...] = ()
    raster_s: float = 0.0
    max_gap_s: float = 2.0
    duplicates: Duplicates = "last"

    def __post_init__(self) -> None:
        if not self.signals:
            raise RecipeError("align: `signals` is empty; name at least one signal")
        if self.raster_s < 0 or self.max_gap_s <= 0:
            raise RecipeError(
                f"align: raster_s = {self.raster_s} and max_gap_s = {self.max_gap_s} must be positive "
                "(raster_s = 0: the first signal's own time stamps)"
            )

    @property
    def needs(self) -> set[str]:
        return set(self.signals)

    @property
    def adds(self) -> set[str]:
        return {*self.signals, *self.optional}

    def start(self) -> AlignState:
        return AlignState()

    def step(self, state: AlignState, block: Log, /) -> tuple[AlignState, Log]:
        wanted = self._wanted(block)
        kept = {name: self._append(state.kept.get(name), block.groups[name], s) for name, s in wanted.items()}
        rows, ready = self._rows(kept, block, state.done)
        lead = self._lead(block)
        series: dict[str, NDArray[np.float64]] = {}
        for group, names in wanted.items():
            near = _Near(kept[group][TIME].to_numpy(), rows, self.raster_s, self.max_gap_s)
            for name in names:
                column, signal = kept[group][name], block.groups[group].signals[name]
                if column.null_count():
                    there = column.is_not_null().to_numpy()
                    sparse = replace(near, t=near.t[there])
                    series[name] = self._resample(
                        sparse, column.drop_nulls().to_numpy(), signal, group == lead
                    )
                else:
                    series[name] = self._resample(near, column.to_numpy(), signal, group == lead)
        names = [n for n in (*self.signals, *self.optional) if n in series]
        frame = pl.DataFrame(
            {TIME: rows, **{n: series[n] for n in names}}, schema_overrides={TIME: pl.Float64}
        )
        if all(np.isnan(x).any() for x in series.values()):  # else no row is empty
            frame = frame.with_columns(pl.col(names).fill_nan(None)).filter(
                pl.any_horizontal(pl.col(names).is_not_null())
            )
        absent = [n for n in self.optional if n not in series]
        frame = frame.with_columns(pl.lit(None, pl.Float64).alias(n) for n in absent)
        signals = {n: block.signals[n] for n in names} | {n: Signal(name=n) for n in absent}
        state = AlignState({g: self._trim(f, ready) for g, f in kept.items()}, ready)
        return state, replace(block, groups={ANALYSIS: Group(ANALYSIS, frame, signals)})

    def _lead(self, block: Log) -> str:
        return block.group_of(self.signals[0]).name if self.raster_s == 0 else ""

    def _wanted(self, block: Log) -> dict[str, list[str]]:
        """Signals to bring, by group."""
        wanted: dict[str, list[str]] = {}
        present = block.signals
        for name in (*self.signals, *(n for n in self.optional if n in present)):
            group = block.group_of(name)
            if not (group.frame.schema[name].is_numeric() or group.frame.schema[name] == pl.Boolean):
                raise LogError(
                    f"log {block.name!r}: signal {name!r} holds {group.frame.schema[name]}, not numbers; "
                    "map another channel to it"
                )
            wanted.setdefault(group.name, []).append(name)
        return wanted

    def _append(self, kept: pl.DataFrame | None, group: Group, names: list[str]) -> pl.DataFrame:
        """Buffered and new rows, sorted, one per time stamp."""
        new = group.frame.select(TIME, pl.col(names).cast(pl.Float64))
        steps = np.diff(group.time)
        if (steps < 0).any():
            new = new.sort(TIME, maintain_order=True)
            steps = np.diff(new[TIME].to_numpy())
        if not steps.all():
            one = {"last": pl.col(names).last(), "first": pl.col(names).first(), "mean": pl.col(names).mean()}
            new = new.group_by(TIME, maintain_order=True).agg(one[self.duplicates])
        return new if kept is None else pl.concat([kept, new])

    def _rows(
        self, kept: Mapping[str, pl.DataFrame], block: Log, done: float
    ) -> tuple[NDArray[np.float64], float]:
        """Row times that can be computed now, and the last time that is settled.

        A row is ready when every signal has a sample at or after it, or has been silent for ``max_gap_s``.
        """
        lead = self._lead(block)
        times = [f[TIME] for f in kept.values() if f.height]
        if not times:
            return np.empty(0), done
        now = float(max(t[-1] for t in times))
        ended = not any(g.frame.height for g in block.groups.values())
        known = [_last_known(f, f.columns[:1] if g == lead else f.columns[1:]) for g, f in kept.items()]
        ready = now if ended else min(max(t, now - self.max_gap_s) for t in known)
        if self.raster_s == 0:
            stamps = kept[lead][TIME].to_numpy()
            return stamps[(stamps > done) & (stamps <= ready)], max(ready, done)
        first = float(min(t[0] for t in times))
        lowest = np.ceil(first / self.raster_s - 1e-9) if done == -np.inf else round(done / self.raster_s) + 1
        highest = np.floor(ready / self.raster_s + 1e-9)
        rows = self.raster_s * np.arange(lowest, highest + 1)
        return rows, (float(rows[-1]) if rows.size else done)

    def _resample(
        self, near: _Near, x: NDArray[np.float64], signal: Signal, own: bool
    ) -> NDArray[np.float64]:
        """Values at the rows from samples ``x`` at the times of ``near``."""
        t, rows = near.t, near.rows
        hold = signal.resample == "hold" or signal.kind != "continuous"
        if not t.size or not rows.size:
            return np.full(rows.size, np.nan)
        value = np.where(near.exact, x[near.before], np.nan)
        if own or signal.resample == "none":
            return value
        if hold:
            return np.where(
                (near.upto > 0) & (rows - t[near.before] <= self.max_gap_s), x[near.before], np.nan
            )
        between = near.between
        left, right = x[near.before[between]], x[near.after[between]]
        value[between] = left + near.share[between] * (right - left)
        if self.raster_s > 0:
            several, pairs, count = near.means
            total = np.add.reduceat(np.append(x, 0.0), pairs)[::2] if pairs.size else np.empty(0)
            value[several] = total / count
        return value

    def _trim(self, frame: pl.DataFrame, done: float) -> pl.DataFrame:
        """What later rows may still need: neighbours further back are too far away to count."""
        reach = max(self.raster_s, self.max_gap_s) + 1e-6
        return frame.slice(int(np.searchsorted(frame[TIME].to_numpy(), done - reach, side="left")))


@dataclass(frozen=True, eq=False)
class _Near:
    """Where ``rows`` lie among the sorted times ``t``; the same for all signals of a group without gaps."""

    t: NDArray[np.float64]
    rows: NDArray[np.float64]
    raster_s: float
    max_gap_s: float

    @cached_property
    def upto(self) -> NDArray[np.intp]:
        """Samples at or before each row."""
        first = np.searchsorted(self.t, self.rows[:1] + 1e-9, side="right")
        own = first + np.arange(self.rows.size)
        if own.size and own[-1] <= self.t.size and np.array_equal(self.t[own[0] - 1 : own[-1]], self.rows):
            return own  # the rows are samples, as of the raster's own signal
        return np.searchsorted(self.t, self.rows + 1e-9, side="right")

    @cached_property
    def before(self) -> NDArray[np.intp]:
        return np.maximum(self.upto - 1, 0)

    @cached_property
    def after(self) -> NDArray[np.intp]:
        return np.minimum(self.upto, self.t.size - 1)

    @cached_property
    def exact(self) -> NDArray[np.bool_]:
        """Whether a row has a sample of its own."""
        return np.asarray((self.upto > 0) & (np.abs(self.t[self.before] - self.rows) <= 1e-9))

    @cached_property
    def width(self) -> NDArray[np.float64]:
        return np.asarray(self.t[self.after] - self.t[self.before])

    @cached_property
    def share(self) -> NDArray[np.float64]:
        """How far a row is on its way from the sample before to the one after."""
        width = np.where(self.width > 0, self.width, 1.0)
        return np.asarray((self.rows - self.t[self.before]) / width)

    @cached_property
    def between(self) -> NDArray[np.intp]:
        """Rows between two samples that are not too far apart."""
        inside = ~self.exact & (self.upto > 0) & (self.upto < self.t.size) & (self.width <= self.max_gap_s)
        return np.flatnonzero(inside)

    @cached_property
    def means(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Rows with two samples or more in the step that ends there; first and end index of these samples,
        one after the other; and their number."""
        start = np.searchsorted(self.t, self.rows - self.raster_s + 1e-9, side="right")
        several = np.flatnonzero(self.upto - start >= 2)
        pairs = np.column_stack([start[several], self.upto[several]]).ravel()
        return several, pairs, (self.upto - start)[several]


def _last_known(frame: pl.DataFrame, names: Sequence[str]) -> float:
    """The earliest of the last times at which each column has a value, -inf where one has none."""
    time = frame[TIME]
    known = [time.filter(frame[n].is_not_null()) if frame[n].null_count() else time for n in names]
    return min((float(t[-1]) if t.len() else -np.inf for t in known), default=-np.inf)
