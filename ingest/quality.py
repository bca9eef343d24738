"""How good the samples of a log are, added up part by part.

Of the samples ``x`` of a signal that are there, a *plateau* is three or more equal ones in a row.

- *stuck*: a plateau of 20 samples and 3 s or more, in a signal that has few plateaus otherwise, neither at
  its lowest nor at its highest value;
- *clipped*: samples in plateaus at the lowest (unless that is 0, rest) or highest value of such a signal;
- *spike*: a sample that leaves both neighbours to the same side by more than 10 times the root mean square
  of all steps, and 10 times as far as these neighbours and the next are from one another.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Event, Log
from ingest.sampling import LISTED, Floats, Sampling, event, number

_PLATEAU = 3  # samples
_STUCK, _STUCK_S = 20, 3.0  # samples and s
_RARE = 0.2  # a signal with a larger share of plateaus is one that moves in steps
_SPIKE = 10.0
_MANY = 1000  # samples of a part that give an idea of the steps of the whole


Indices = NDArray[np.int64]


class Run(NamedTuple):
    """Equal samples in a row, from one time to another."""

    start: float
    end: float
    value: float
    samples: int


@dataclass
class Samples:
    """What the parts of one signal have shown."""

    rows: int = 0
    missing: int = 0
    clock: Sampling | None = None  # of the samples that are there, once one is missing
    low: Any = None
    high: Any = None
    varies: bool = False
    last: Any = None
    plateaus: int = 0
    at_low: int = 0
    at_high: int = 0
    runs: list[tuple[float, Run]] = field(default_factory=list)  # the longest, as a heap
    open: Run | None = None
    tail: tuple[Floats, Floats] = (np.empty(0), np.empty(0))
    steps: int = 0
    squares: float = 0.0
    candidates: list[tuple[float, float]] = field(
        default_factory=list
    )  # height and time of what may be spikes

    def add(self, time: Floats, values: pl.Series, clock: Sampling) -> None:
        """Takes in the next rows; ``clock`` knows the stamps of all rows before."""
        present = values.is_not_null()
        missing = values.null_count()
        if missing and self.clock is None:
            self.clock = clock.copy()
        if self.clock is not None:
            self.clock.add(time[present.to_numpy()])
        self.rows, self.missing = self.rows + len(values), self.missing + missing
        known = values.filter(present) if missing else values
        if not len(known):
            return
        if not (values.dtype.is_numeric() or values.dtype == pl.Boolean):
            self.varies |= known.n_unique() > 1 or self.last not in (None, known[0])
            self.last = known[0]
            return
        ends: tuple[Any, Any] = (known.min(), known.max())
        low, high = ends if self.low is None else (min(self.low, ends[0]), max(self.high, ends[1]))
        self.at_low, self.at_high = (
            (self.at_low if low == self.low else 0),
            (self.at_high if high == self.high else 0),
        )
        self.low, self.high, self.varies = low, high, low != high
        if values.dtype.is_float():
            x = known.cast(pl.Float64).to_numpy()
            t = time[present.to_numpy()] if missing else time
            if not np.isfinite(ends[0] + ends[1]):
                t, x = t[np.isfinite(x)], x[np.isfinite(x)]
            if not len(x):
                return
            self._add_runs(t, x)
            self._add_steps(t, x)

    def _add_runs(self, t: Floats, x: Floats) -> None:
        first, end = _bounds(x)
        open_, self.open = self.open, None
        if open_ is not None and open_.value != x[0]:
            self._close(open_)
            open_ = None
        # of the many plateaus between the first and the last run, only long ones are looked at one by one
        few = end - first >= _STUCK
        few[[0, -1]] = True
        values, samples = x[first[~few]], (end - first)[~few]
        self.plateaus += int(samples.sum())
        self.at_low += int(samples[values == self.low].sum())
        self.at_high += int(samples[values == self.high].sum())
        for a, b in zip(first[few].tolist(), end[few].tolist(), strict=True):
            run = Run(float(t[a]), float(t[b - 1]), float(x[a]), b - a)
            if a == 0 and open_ is not None:
                run = Run(open_.start, run.end, run.value, run.samples + open_.samples)
            if b == len(x):
                self.open = run
            else:
                self._close(run)

    def _close(self, run: Run) -> None:
        if run.samples < _PLATEAU:
            return
        self.plateaus += run.samples
        self.at_low += run.samples if run.value == self.low else 0
        self.at_high += run.samples if run.value == self.high else 0
        duration = run.end - run.start
        if run.samples >= _STUCK and duration >= _STUCK_S:
            (heapq.heappush if len(self.runs) < 5 * LISTED else heapq.heappushpop)(self.runs, (duration, run))

    def _add_steps(self, t: Floats, x: Floats) -> None:
        before_t, before = self.tail
        step = np.diff(x)
        if len(x) < _MANY:  # few enough to look at them with the four before
            near_t, near = np.append(before_t, t), np.append(before, x)
        else:
            near_t, near = np.append(before_t, t[:4]), np.append(before, x[:4])
        self._look(near_t, near, np.diff(near))
        if len(x) >= _MANY:
            self._look(t, x, step)
        first = x[0] - before[-1] if len(before) else 0.0
        self.steps += len(step) + bool(len(before))
        self.squares += _squares(step) + float(first * first)
        self.tail = np.append(before_t, t[-4:])[-4:], np.append(before, x[-4:])[-4:]

    def _look(self, t: Floats, x: Floats, step: Floats) -> None:
        """Notes what may be spikes, two samples from either end or more; ``step``: from one to the next."""
        if len(x) < 5:
            return
        least = 0.0 if len(x) < _MANY else (0.5 * _SPIKE) ** 2 * _squares(step) / len(step)
        if step.max() * step.min() >= -least:  # nor is that of any two in a row
            return
        at = np.flatnonzero(step[1:-2] * step[2:-1] < -least) + 2
        height = np.minimum(np.abs(step[at - 1]), np.abs(step[at]))
        around = np.abs(np.stack([x[at + 1] - x[at - 1], step[at - 2], step[at + 1]]))
        sharp = height > _SPIKE * around.max(axis=0, initial=0.0)
        self.candidates += zip(height[sharp].tolist(), t[at[sharp]].tolist(), strict=True)

    def finish(self) -> dict[str, Any]:
        """Counts, ends, and what is suspicious."""
        if self.open is not None:
            self._close(self.open)
            self.open = None
        clipping, stuck = self._plateaus()
        return {
            "missing": self.missing,
            "missing_share": round(self.missing / self.rows, 6) if self.rows else None,
            "min": number(self.low),
            "max": number(self.high),
            "constant": self.rows - self.missing > 1 and not self.varies,
            "stuck": len(stuck),
            "clipped": clipping,
            "spikes": len(self.spikes()),
        }

    def spikes(self) -> list[float]:
        """Their times, highest first."""
        least = _SPIKE * np.sqrt(self.squares / self.steps) if self.steps else 0.0
        return [t for height, t in sorted(self.candidates, reverse=True) if height > least]

    def stretches(self) -> list[tuple[str, Run]]:
        """The long plateaus that are suspicious, longest first: ``clipping`` or ``stuck``."""
        clipping, stuck = self._plateaus()
        ends = [r for _, r in self.runs if clipping and r.value in self._ends()]
        return [("clipping", r) for r in sorted(ends)] + [("stuck", r) for r in stuck]

    def _ends(self) -> set[float]:
        return {float(self.high), *((float(self.low),) if self.low != 0 else ())}

    def _plateaus(self) -> tuple[int, list[Run]]:
        """Clipped samples and stuck stretches."""
        there = self.rows - self.missing
        if not self.varies or not there:
            return 0, []
        inside = [r for _, r in self.runs if r.value not in (self.low, self.high)]
        held = sum(r.samples for r in inside)
        if self.at_low + self.at_high > there / 2:
            return 0, []
        ordinary = self.plateaus - self.at_low - self.at_high - held
        if ordinary > _RARE * (there - held - self.at_low - self.at_high):
            return 0, []
        return self.at_high + (self.at_low if self.low != 0 else 0), sorted(
            inside, key=lambda r: r.start - r.end
        )


class Quality:
    """Adds up the parts of a log: ``add`` each, then ask."""

    def __init__(self) -> None:
        self.clocks: dict[str, Sampling] = {}
        self.samples: dict[str, dict[str, Samples]] = {}

    def add(self, part: Log) -> None:
        for name, group in part.groups.items():
            clock = self.clocks.setdefault(name, Sampling())
            known = self.samples.setdefault(name, {s: Samples() for s in group.signals})
            for signal, samples in known.items():
                samples.add(group.time, group.frame[signal], clock)
            clock.add(group.time)

    def clock(self, group: str) -> Sampling:
        """The time stamps of a group."""
        return self.clocks.get(group) or Sampling()

    def of_signals(self) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Group, signal and what is found of it; its sampling is that of the samples that are there."""
        for group, known in self.samples.items():
            whole = self.clock(group).quality()
            for name, samples in known.items():
                sampling = whole if samples.clock is None else samples.clock.quality()
                yield group, name, {**sampling, **samples.finish()}

    @property
    def span(self) -> list[float] | None:
        """First and last time in s, None without a row."""
        known = [c for c in self.clocks.values() if c.rows]
        return [min(c.low for c in known), max(c.high for c in known)] if known else None

    def events(self) -> tuple[Event, ...]:
        """What is suspicious and has a place in time, in order of time; the worst of each kind and signal."""
        found = [e for clock in self.clocks.values() for e in clock.events()]
        for known in self.samples.values():
            for name, samples in known.items():
                samples.finish()
                runs = samples.stretches()[:LISTED]
                found += [event(kind, r.start, r.end, name) for kind, r in runs]
                found += [event("spike", t, t, name) for t in samples.spikes()[:LISTED]]
        return tuple(sorted(dict.fromkeys(found), key=lambda e: (e.t_start, e.kind, e.channel or "")))


def _squares(x: Floats) -> float:
    return float(np.einsum("i,i->", x, x))  # np.dot would start threads, which wait for one another


def _bounds(x: Floats) -> tuple[Indices, Indices]:
    """First and end index of the first run of equal values, of the last, and of every plateau between."""
    same = x[1:] == x[:-1]
    triple = np.flatnonzero(same[1:] & same[:-1])
    part = np.flatnonzero(np.diff(triple) > 1)
    first = triple[np.append(0, part + 1)[: len(triple)]]
    end = triple[np.append(part, -1)[: len(triple)]] + _PLATEAU
    if not len(first) or first[0] > 0:
        first, end = np.append(0, first), np.append(1 + bool(len(same) and same[0]), end)
    if end[-1] < len(x):
        first, end = np.append(first, len(x) - 1 - bool(same[-1])), np.append(end, len(x))
    return first, end
