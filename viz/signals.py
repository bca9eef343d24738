"""The log's own signals at their native rates: one plot per unit, text as lanes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
import rerun as rr

from ingest.log import Group, Log
from viz import send
from viz.colours import of_index
from viz.raster import Raster, Reduction, in_order
from viz.series import lane, limits, union, usual_step

BYTES = 20e6
"""Of all signals' lines in a recording: what a viewer opens and draws at once. Longer ones are drawn as their
envelopes, with every value about the moments that matter."""
ROW_BYTES = 14.5
"""Of a row without its values, measured; a value takes its 4 or 8 and next to nothing more."""
ENVELOPE_POINTS, FEWEST = 50_000, 4_000
DETAIL = 0.25
"""Share of the bytes that is kept for the moments."""
SERIES_PER_PANEL = 8
RATIO = 10.0
"""Signals whose greatest values differ by more do not share a plot."""
MARGIN = 0.05


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One plot: signals of one unit and about one size."""

    title: str
    lines: tuple[send.Line, ...]
    range: tuple[float, float]
    """A little more than round limits around all values, so that the scale has ticks."""

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals' names."""
        return tuple(line.name for line in self.lines)


@dataclass(frozen=True, kw_only=True)
class LogContents:
    """What was drawn of a log, for the layout and the summary."""

    panels: tuple[Panel, ...]
    lanes: tuple[str, ...]
    remarks: tuple[str, ...]
    """What was not drawn as it is."""


@dataclass(frozen=True, kw_only=True)
class _Drawn:
    """Where a signal is in the recording, and its least and greatest value."""

    entity: str
    field: str
    low: float
    high: float


def log_signals(rec: rr.RecordingStream, log: Log, moments: Sequence[float] = ()) -> LogContents:
    """All signals of ``log`` below ``/signals`` and ``/states``; ``moments`` (s) are drawn in detail where a
    log is too long for that throughout."""
    reduced = reductions(log, moments)
    drawn: dict[str, _Drawn] = {}
    for key, group in log.groups.items():
        drawn |= _log_group(rec, key, group, reduced.get(key))
    text = [n for n, g in _each(log) if _is_text(g, n)]
    return LogContents(
        panels=tuple(_panel(log, names, drawn) for names in _plots(log)),
        lanes=tuple(_log_lane(rec, log.group_of(name), name) for name in text),
        remarks=(
            *(f"{n}: neither number nor text, not drawn" for n, g in _each(log) if not _is_drawn(g, n)),
            *(_reduced(log.groups[key], how) for key, how in reduced.items()),
        ),
    )


def reductions(log: Log, moments: Sequence[float] = ()) -> dict[str, Reduction]:
    """How the groups are drawn that are too long to be drawn as they are, so that all fit into ``BYTES``."""
    cost = {key: _row_bytes(group) for key, group in log.groups.items()}
    rows = {key: group.frame.height for key, group in log.groups.items()}

    def needed(points: float) -> float:
        return sum(min(rows[key], points) * cost[key] for key in rows)

    if needed(np.inf) <= BYTES:
        return {}
    points, allowed = ENVELOPE_POINTS, (1.0 - DETAIL if moments else 1.0) * BYTES
    while points > FEWEST and needed(points) > allowed:
        points = int(0.8 * points)
    long = [key for key in rows if rows[key] > points]
    share = DETAIL * BYTES / max(sum(cost[key] for key in long), 1.0) / max(len(moments), 1)
    return {
        key: Reduction(points=points, windows=_windows(log.groups[key], moments, int(share))) for key in long
    }


def _row_bytes(group: Group) -> float:
    schema = group.frame.schema
    sizes = [4.0 if schema[n] == pl.Float32 else 8.0 for n in _numbers(group)]
    return ROW_BYTES + sum(sizes) if sizes else 0.0


def _numbers(group: Group) -> list[str]:
    return [name for name in group.signals if _is_number(group, name)]


def _windows(group: Group, moments: Sequence[float], count: int) -> tuple[tuple[float, float], ...]:
    """Stretches of about ``count`` rows around each of the moments."""
    half = 0.5 * count * usual_step(group.time)
    return tuple(union((at - half, at + half) for at in moments))


def _reduced(group: Group, how: Reduction) -> str:
    words = f"group {group.name}: {group.frame.height} rows, drawn as the least and greatest of each stretch"
    if not how.windows:
        return words
    spans = ", ".join(f"{a:.4g} to {b:.4g} s" for a, b in how.windows[:4])
    return f"{words}; every value from {spans}" + (" …" if len(how.windows) > 4 else "")


def _each(log: Log) -> list[tuple[str, Group]]:
    return [(name, group) for group in log.groups.values() for name in group.signals]


def _is_number(group: Group, name: str) -> bool:
    return group.frame.schema[name].is_numeric()


def _is_text(group: Group, name: str) -> bool:
    return group.frame.schema[name] in (pl.String, pl.Boolean, pl.Categorical, pl.Enum)


def _is_drawn(group: Group, name: str) -> bool:
    return _is_number(group, name) or _is_text(group, name)


def _plots(log: Log) -> list[list[str]]:
    """The signals of each plot: of one unit, one family (the name before its last dot) and one size.

    Signals without a unit share no scale, so each has its own plot.
    """
    families: dict[tuple[str, str | None], list[str]] = defaultdict(list)
    for name, group in _each(log):
        if _is_number(group, name):
            family = name.rpartition(".")[0]
            families[family, group.signals[name].unit].append(name)
    plots: list[list[str]] = []
    for family, unit in sorted(families, key=lambda key: key[0]):
        names = families[family, unit]
        plots += _of_one_size({name: _size(log, name) for name in names}) if unit else [[n] for n in names]
    return plots


def _size(log: Log, name: str) -> float:
    values = log.values(name)
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _of_one_size(sizes: Mapping[str, float]) -> list[list[str]]:
    """Names whose sizes differ by less than ``RATIO``, at most ``SERIES_PER_PANEL`` together, in their order.

    >>> _of_one_size({"n_Eng": 4000.0, "n_Turb": 120e3, "n_Fan": 900.0, "n_Off": 0.0})
    [['n_Eng', 'n_Fan', 'n_Off'], ['n_Turb']]
    """
    plots: list[list[str]] = []
    for name, size in sizes.items():
        for plot in plots:
            known = [s for s in (sizes[n] for n in plot) if s > 0.0]
            low, high = min(known, default=size), max(known, default=size)
            fits = size == 0.0 or not known or max(high, size) < RATIO * min(low, size)
            if fits and len(plot) < SERIES_PER_PANEL:
                plot.append(name)
                break
        else:
            plots.append([name])
    return plots


def _log_group(rec: rr.RecordingStream, key: str, group: Group, how: Reduction | None) -> dict[str, _Drawn]:
    """All numbers of a group as one entity, whose rows they share."""
    if not (names := _numbers(group)):
        return {}
    path, raster = send.entity("signals", key), Raster(group, names, how)
    fields = send.field_names(names)
    columns = {field: raster.values(name) for name, field in zip(names, fields, strict=True)}
    send.rows(rec, path, raster.time, columns)
    drawn = {}
    for name, (field, values) in zip(names, columns.items(), strict=True):
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (np.inf, -np.inf)
        drawn[name] = _Drawn(entity=path, field=field, low=low, high=high)
    return drawn


def _panel(log: Log, names: list[str], drawn: Mapping[str, _Drawn]) -> Panel:
    unit = log.signals[names[0]].unit
    low, high = min(drawn[n].low for n in names), max(drawn[n].high for n in names)
    low, high = limits(low, high) if low <= high else (0.0, 1.0)
    margin = MARGIN * (high - low)
    shown = ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} … ({len(names)})"
    return Panel(
        title=f"{shown} [{unit or 'unit unknown'}]",
        lines=tuple(
            send.Line(entity=drawn[n].entity, field=drawn[n].field, name=n, colour=of_index(i))
            for i, n in enumerate(names)
        ),
        range=(low - margin, high + margin),
    )


def _log_lane(rec: rr.RecordingStream, group: Group, name: str) -> str:
    time, rows = in_order(group)
    text = group.frame.select(pl.col(name).cast(pl.String).fill_null(""))[name].to_numpy()[rows]
    path = send.entity("states", name)
    at, states = lane(time, text)
    palette = {state: of_index(i) for i, state in enumerate(sorted(set(states) - {""}))}
    send.states(rec, path, at, states, palette)
    return path
