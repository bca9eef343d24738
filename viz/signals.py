"""The log's own signals at their native rates: one plot per unit, text as lanes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from ingest.log import Group, Log
from viz import send
from viz.colours import of_index
from viz.series import Array, break_at_gaps, envelope, lane, limits, union, usual_step

BYTES = 20e6
"""Of all signals' lines in a recording: what a viewer opens and draws at once. Longer ones are drawn as their
envelopes, with every value about the moments that matter."""
ROW_BYTES, VALUE_BYTES = 15.0, 8.4
"""Of a row of a plot and of a value in it, measured."""
ENVELOPE_POINTS, FEWEST = 50_000, 4_000
DETAIL = 0.25
"""Share of the bytes that is kept for the moments."""
SERIES_PER_PANEL = 8
RATIO = 10.0
"""Signals whose greatest values differ by more do not share a plot."""
MARGIN = 0.05


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One plot: signals of one unit, in one entity per group."""

    title: str
    signals: tuple[str, ...]
    entities: tuple[str, ...]
    range: tuple[float, float]
    """A little more than round limits around all values, so that the scale has ticks."""


@dataclass(frozen=True, kw_only=True)
class LogContents:
    """What was drawn of a log, for the layout and the summary."""

    panels: tuple[Panel, ...]
    lanes: tuple[str, ...]
    remarks: tuple[str, ...]
    """What was not drawn as it is."""


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """How a long group is drawn: as an envelope of about ``points`` points, and as it is inside ``windows``
    (s)."""

    points: int
    windows: tuple[tuple[float, float], ...] = ()


def log_signals(rec: rr.RecordingStream, log: Log, moments: Sequence[float] = ()) -> LogContents:
    """All signals of ``log`` below ``/signals`` and ``/states``; ``moments`` (s) are drawn in detail where a
    log is too long for that throughout."""
    plots = _plots(log)
    reduced = reductions(log, plots, moments)
    panels = [_log_panel(rec, log, names, reduced) for names in plots]
    text = [n for n, g in _each(log) if _is_text(g, n)]
    return LogContents(
        panels=tuple(panels),
        lanes=tuple(_log_lane(rec, log.group_of(name), name) for name in text),
        remarks=(
            *(f"{n}: neither number nor text, not drawn" for n, g in _each(log) if not _is_drawn(g, n)),
            *(_reduced(log.groups[key], how) for key, how in reduced.items()),
        ),
    )


def reductions(
    log: Log, plots: Sequence[Sequence[str]], moments: Sequence[float] = ()
) -> dict[str, Reduction]:
    """How the groups are drawn that are too long to be drawn as they are, so that all fit into ``BYTES``."""
    cost = {
        key: sum(
            ROW_BYTES + VALUE_BYTES * len(shown)
            for names in plots
            if (shown := [n for n in names if n in group.signals])
        )
        for key, group in log.groups.items()
    }
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


def _log_panel(
    rec: rr.RecordingStream, log: Log, names: list[str], reduced: Mapping[str, Reduction]
) -> Panel:
    unit = log.signals[names[0]].unit
    by_group: dict[str, list[str]] = defaultdict(list)
    for key, group in log.groups.items():
        by_group[key] += [name for name in names if name in group.signals]
    entities, extremes = [], []
    for key, members in by_group.items():
        if members:
            entities.append(send.entity("signals", key, f"{members[0]} [{unit or '?'}]"))
            colours = [of_index(names.index(name)) for name in members]
            time, values = curves(log.groups[key], members, reduced.get(key))
            send.lines(rec, entities[-1], time, values, names=members, colours=colours)
            extremes += [
                f(values[np.isfinite(values)]) for f in (np.min, np.max) if np.isfinite(values).any()
            ]
    low, high = limits(min(extremes, default=0.0), max(extremes, default=1.0))
    margin = MARGIN * (high - low)
    shown = ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} … ({len(names)})"
    return Panel(
        title=f"{shown} [{unit or 'unit unknown'}]",
        signals=tuple(names),
        entities=tuple(entities),
        range=(low - margin, high + margin),
    )


def curves(group: Group, names: list[str], how: Reduction | None = None) -> tuple[Array, Array]:
    """Time stamps (m,) and values (m, k) to draw: in order, broken at gaps, reduced as ``how`` says."""
    time, rows = in_order(group)
    columns = group.frame.select(pl.col(name).cast(pl.Float64).fill_null(float("nan")) for name in names)
    values = send.flat(columns.to_numpy())[rows]
    time, values = break_at_gaps(time, values)
    if how is None or time.size <= how.points:
        return time, values
    edges = [0, *np.searchsorted(time, np.array(how.windows).ravel()).tolist(), time.size]
    parts = []
    for i, (start, end) in enumerate(pairwise(edges)):
        part = time[start:end], values[start:end]
        outside = i % 2 == 0
        parts.append(
            envelope(*part, max(2, round(how.points * (end - start) / time.size))) if outside else part
        )
    return np.concatenate([t for t, _ in parts]), np.concatenate([v for _, v in parts])


def _log_lane(rec: rr.RecordingStream, group: Group, name: str) -> str:
    time, rows = in_order(group)
    text = group.frame.select(pl.col(name).cast(pl.String).fill_null(""))[name].to_numpy()[rows]
    path = send.entity("states", name)
    at, states = lane(time, text)
    palette = {state: of_index(i) for i, state in enumerate(sorted(set(states) - {""}))}
    send.states(rec, path, at, states, palette)
    return path
