"""The log: what a bench or a car recorded, as tables at their native rates.

A :class:`Log` holds one :class:`Group` per raster of the source (all signals of a group share its time
stamps), :class:`Event` rows (ground truth or findings) and facts about where it came from. Everything is
frozen: a step that changes something returns a new log. A part of a log is a log (:meth:`Log.between`), so
what takes a whole log also takes it block by block.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import DynoscopeError, LogError, did_you_mean

__all__ = ["TIME", "DynoscopeError", "Event", "Group", "Kind", "Log", "LogError", "Resample", "Signal"]

TIME = "time"
Kind = Literal["continuous", "state", "counter"]
Resample = Literal["linear", "hold", "none"]


@dataclass(frozen=True, kw_only=True)
class Signal:
    """What is known of one channel besides its values.

    ``value = scale * source value + offset``; ``unit`` is the unit of ``value`` and None where nothing is
    known. ``flags`` say what a reader must not overlook, such as ``"unit assumed"``.
    """

    name: str
    unit: str | None = None
    kind: Kind = "continuous"
    resample: Resample = "linear"
    source_name: str | None = None
    source_unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    description: str = ""
    flags: tuple[str, ...] = ()

    def to_metadata(self) -> dict[str, str]:
        """Flat text pairs, for Arrow field metadata and MCAP channel metadata; defaults are left out."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        return {k: v if isinstance(v, str) else json.dumps(v) for k, v in given.items() if k != "name"}

    @classmethod
    def from_metadata(cls, name: str, pairs: Mapping[str, str]) -> Signal:
        """The inverse of :meth:`to_metadata`; pairs it does not know are ignored.

        >>> s = Signal(name="p_Int", unit="kPa", scale=0.001, flags=("unit assumed",))
        >>> Signal.from_metadata("p_Int", s.to_metadata()) == s
        True
        """
        known: dict[str, Any] = {f.name: pairs[f.name] for f in fields(cls) if f.name in pairs}
        known.update({k: json.loads(known[k]) for k in ("scale", "offset", "flags") if k in known})
        return cls(**{**known, "name": name, "flags": tuple(known.get("flags", ()))})


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that held from ``t_start`` to ``t_end`` (s on the log's clock; None: to the end).

    ``source`` says whose word it is: ``"truth"``, ``"quality"``, ``"dynoscope"``, a person, ... .
    ``kind`` is a fault name or what happened; ``magnitude`` is in ``unit`` (``"1"``, ``"mm"``, ``"%"``).
    """

    t_start: float
    t_end: float | None = None
    kind: str
    channel: str | None = None
    confidence: float | None = None
    source: str
    magnitude: float | None = None
    unit: str | None = None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Group:
    """One raster: a frame whose first column is ``time`` (Float64, s, never null) and its signals.

    Missing values are null; NaN is turned into null on construction, so that there is one word for it.
    Rows keep the order of the source: sorting and resampling is the business of ``stages.align``.

    Raises:
        LogError: no time column, a time that is not a number, or signals that are not the frame's columns.
    """

    name: str
    frame: pl.DataFrame
    signals: Mapping[str, Signal] = field(default_factory=dict)

    def __post_init__(self) -> None:
        frame = self.frame
        if TIME not in frame.columns:
            raise LogError(f"group {self.name!r} has no {TIME!r} column; it has {frame.columns}")
        order = [TIME, *(c for c in frame.columns if c != TIME)]
        schema = frame.schema
        if frame.columns != order or schema[TIME] != pl.Float64:
            frame = frame.select(pl.col(TIME).cast(pl.Float64), *order[1:])
        sums = {s.name: float(s.sum()) for s in frame.get_columns()[1:] if s.dtype.is_float()}
        if holed := [c for c, total in sums.items() if np.isnan(total)]:  # quicker than asking each value
            frame = frame.with_columns(pl.col(holed).fill_nan(None))
        if bad := int(np.isnan(frame[TIME].to_numpy()).sum()):
            raise LogError(f"group {self.name!r}: {bad} of {frame.height} time stamps are missing")
        signals = dict(self.signals) or {c: Signal(name=c) for c in order[1:]}
        if list(signals) != order[1:]:
            signals = {c: signals[c] if c in signals else Signal(name=c) for c in order[1:]}
        object.__setattr__(self, "frame", frame)
        object.__setattr__(self, "signals", signals)

    def adding(self, columns: Iterable[pl.Series], signals: Mapping[str, Signal]) -> Group:
        """With more ``columns``, or others in the place of its own, NaN being null in them, and the
        ``signals`` of those that are new: what was there is not looked at again."""
        group = copy(self)
        object.__setattr__(group, "frame", self.frame.with_columns(columns))
        object.__setattr__(group, "signals", {**self.signals, **signals})
        return group

    @property
    def time(self) -> NDArray[np.float64]:
        """Time stamps in s, shape (rows,)."""
        return self.frame[TIME].to_numpy()

    @property
    def rate_hz(self) -> float:
        """Median sampling rate, 0 where there are fewer than two samples."""
        step = float(np.median(np.diff(self.time))) if self.frame.height > 1 else 0.0
        return 1.0 / step if step > 0 else 0.0


@dataclass(frozen=True, eq=False)
class Log:
    """Groups at native rates, events and facts; a signal's name is unique in the whole log.

    ``facts`` are JSON values about the source (``file``, ``sha256``, ``format``, ``vehicle``,
    ``start_time`` ...); ``time`` counts on the log's own clock.

    Raises:
        LogError: two groups hold a signal of the same name.
    """

    name: str
    groups: Mapping[str, Group]
    events: tuple[Event, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        seen: dict[str, str] = {}
        for group in self.groups.values():
            for name in group.signals:
                if name in seen:
                    raise LogError(
                        f"log {self.name!r}: signal {name!r} is in group {seen[name]!r} "
                        f"and in {group.name!r}; rename one of them"
                    )
                seen[name] = group.name

    @property
    def signals(self) -> dict[str, Signal]:
        """Every signal of every group by name."""
        return {n: s for g in self.groups.values() for n, s in g.signals.items()}

    @property
    def span(self) -> tuple[float, float]:
        """First and last time stamp in s.

        Raises:
            LogError: the log has no rows.
        """
        times = [g.time for g in self.groups.values() if g.frame.height]
        if not times:
            raise LogError(f"log {self.name!r} has no samples")
        return float(min(t.min() for t in times)), float(max(t.max() for t in times))

    def group_of(self, signal: str) -> Group:
        """The group that holds ``signal``.

        Raises:
            LogError: there is none; the message lists near names.
        """
        for group in self.groups.values():
            if signal in group.signals:
                return group
        hint = did_you_mean(signal, self.signals)
        raise LogError(f"log {self.name!r} has no signal {signal!r}; {hint}")

    def values(self, signal: str) -> NDArray[np.float64]:
        """Values of a numeric signal as float64, shape (rows,), missing ones NaN."""
        series = self.group_of(signal).frame[signal]
        if series.dtype != pl.Float64:
            series = series.cast(pl.Float64)
        return series.to_numpy()  # nulls as NaN

    def between(self, start: float, end: float) -> Log:
        """The part with ``start <= time < end``, events and facts kept."""
        inside = pl.col(TIME).is_between(start, end, closed="left")
        groups = {k: replace(g, frame=g.frame.filter(inside)) for k, g in self.groups.items()}
        return replace(self, groups=groups)

    def with_events(self, events: Iterable[Event]) -> Log:
        """The same log with ``events`` added."""
        return replace(self, events=(*self.events, *events))

    def equals(self, other: Log) -> bool:
        """Same name, groups (values, types, signals, order), events and facts."""
        return (
            (self.name, self.events, dict(self.facts), list(self.groups))
            == (other.name, other.events, dict(other.facts), list(other.groups))
            and all(dict(g.signals) == dict(other.groups[k].signals) for k, g in self.groups.items())
            and all(
                g.frame.schema == other.groups[k].frame.schema and g.frame.equals(other.groups[k].frame)
                for k, g in self.groups.items()
            )
        )
