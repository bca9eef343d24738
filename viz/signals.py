"""The log's own signals at their native rates: one plot per unit, text as lanes."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from ingest.log import Group, Log
from viz import send
from viz.colours import of_index
from viz.series import Array, break_at_gaps, envelope, lane, limits

FULL_ROWS = 200_000
"""A group with more rows is drawn as its envelope ..."""
ENVELOPE_POINTS = 50_000
"""... of about this many points."""
SERIES_PER_PANEL = 8


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One plot: signals of one unit, in one entity per group."""

    title: str
    signals: tuple[str, ...]
    entities: tuple[str, ...]
    range: tuple[float, float]
    """Round limits around all values, so that the scale has ticks."""


@dataclass(frozen=True, kw_only=True)
class LogContents:
    """What was drawn of a log, for the layout and the summary."""

    panels: tuple[Panel, ...]
    lanes: tuple[str, ...]
    reduced: tuple[str, ...]
    """Groups drawn as their envelope."""
    left_out: tuple[str, ...]
    """Signals that are neither numbers nor text."""


def log_signals(rec: rr.RecordingStream, log: Log) -> LogContents:
    """All signals of ``log`` below ``/signals`` and ``/states``."""
    panels = [_log_panel(rec, log, unit, names) for unit, names in _plots(log)]
    text = [n for n, g in _each(log) if not _is_number(g, n) and _is_text(g, n)]
    return LogContents(
        panels=tuple(panels),
        lanes=tuple(_log_lane(rec, log.group_of(name), name) for name in text),
        reduced=tuple(g.name for g in log.groups.values() if g.frame.height > FULL_ROWS),
        left_out=tuple(n for n, g in _each(log) if not _is_number(g, n) and n not in text),
    )


def in_order(group: Group) -> tuple[Array, NDArray[np.intp]]:
    """Rising time stamps of a group and the rows they come from; what is not finite is left out."""
    rows = np.argsort(group.time, kind="stable")
    rows = rows[np.isfinite(group.time[rows])]
    return group.time[rows], rows


def _each(log: Log) -> list[tuple[str, Group]]:
    return [(name, group) for group in log.groups.values() for name in group.signals]


def _is_number(group: Group, name: str) -> bool:
    return group.frame.schema[name].is_numeric()


def _is_text(group: Group, name: str) -> bool:
    return group.frame.schema[name] in (pl.String, pl.Boolean, pl.Categorical, pl.Enum)


def _plots(log: Log) -> list[tuple[str | None, list[str]]]:
    """Unit and signals of each plot; signals without a unit share no scale, so each has its own plot."""
    by_unit: dict[str | None, list[str]] = defaultdict(list)
    for name, group in _each(log):
        if _is_number(group, name):
            by_unit[group.signals[name].unit].append(name)
    plots: list[tuple[str | None, list[str]]] = []
    for unit, names in by_unit.items():
        width = SERIES_PER_PANEL if unit else 1
        plots += [(unit, names[i : i + width]) for i in range(0, len(names), width)]
    return plots


def _log_panel(rec: rr.RecordingStream, log: Log, unit: str | None, names: list[str]) -> Panel:
    by_group: dict[str, list[str]] = defaultdict(list)
    for key, group in log.groups.items():
        by_group[key] += [name for name in names if name in group.signals]
    entities, extremes = [], []
    for key, members in by_group.items():
        if members:
            entities.append(send.entity("signals", key, f"{members[0]} [{unit or '?'}]"))
            colours = [of_index(names.index(name)) for name in members]
            time, values = curves(log.groups[key], members)
            send.lines(rec, entities[-1], time, values, names=members, colours=colours)
            extremes += [
                f(values[np.isfinite(values)]) for f in (np.min, np.max) if np.isfinite(values).any()
            ]
    shown = ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} … ({len(names)})"
    return Panel(
        title=f"{shown} [{unit or 'unit unknown'}]",
        signals=tuple(names),
        entities=tuple(entities),
        range=limits(min(extremes, default=0.0), max(extremes, default=1.0)),
    )


def curves(group: Group, names: list[str]) -> tuple[Array, Array]:
    """Time stamps (m,) and values (m, k) to draw: in order, broken at gaps, reduced if long."""
    time, rows = in_order(group)
    columns = group.frame.select(pl.col(name).cast(pl.Float64).fill_null(float("nan")) for name in names)
    values = send.flat(columns.to_numpy())[rows]
    time, values = break_at_gaps(time, values)
    return envelope(time, values, ENVELOPE_POINTS) if group.frame.height > FULL_ROWS else (time, values)


def _log_lane(rec: rr.RecordingStream, group: Group, name: str) -> str:
    time, rows = in_order(group)
    text = group.frame.select(pl.col(name).cast(pl.String).fill_null(""))[name].to_numpy()[rows]
    path = send.entity("states", name)
    at, states = lane(time, text)
    palette = {state: of_index(i) for i, state in enumerate(sorted(set(states) - {""}))}
    send.states(rec, path, at, states, palette)
    return path
