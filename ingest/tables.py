"""Tables of others as groups of a log: which column is time, what is a signal, names that occur twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import polars as pl

from ingest.clock import Clock, no_time, time_column
from ingest.errors import LogError
from ingest.log import TIME, Group, Log, Signal
from ingest.maps import TimeMap, match

SHARED_NAME = "several groups have a channel of this name"


class Table(NamedTuple):
    """Columns as they are in the file, and what is known of them; units and names by column."""

    frame: pl.DataFrame
    signals: Mapping[str, Signal]


def log_of_tables(
    where: str, name: str, tables: Mapping[str, Table], wanted: TimeMap, start: int | None = None
) -> Log:
    """A log with one group per table; columns that are not signals are told in the fact ``notes``.

    The time column of each is known by its name or the map; a table without one is left out and told, unless
    the map gives a rate. Dates of all tables count from ``start`` in ns, else from the earliest. A name that
    several tables have becomes ``<table>.<name>``.

    Raises:
        LogError: no table has a time column.
    """
    notes: list[str] = []
    clocks = {k: _clock_column(where, t, wanted) for k, t in tables.items()}
    timed = {k: t for k, t in tables.items() if clocks[k] is not None or wanted.rate is not None}
    if not timed:
        raise no_time(where, [c for t in tables.values() for c in t.frame.columns], wanted)
    notes += [f"group {k!r} was left out: it has no time column" for k in tables if k not in timed]
    start = earliest(timed, wanted) if start is None else start
    groups: dict[str, Group] = {}
    facts: dict[str, Any] = {}
    for key, table in timed.items():
        column = clocks[key]
        frame, skipped = _usable(table.frame, column)
        unit = known.unit if column and (known := table.signals.get(column)) else None
        clock = Clock(where, unit, wanted, start_ns=start)
        frame = clock.counted(frame) if column is None else clock.timed(frame, column)
        signals = {s: table.signals.get(s, Signal(name=s)) for s in frame.columns if s != TIME}
        facts |= clock.facts
        notes += [*facts.pop("notes", ()), *skipped]
        groups[key] = Group(key, frame, signals)
    return Log(name, distinct(groups), (), facts | ({"notes": notes} if notes else {}))


def earliest(tables: Mapping[str, Table], wanted: TimeMap) -> int | None:
    """The earliest date of all tables in ns, None where there are none."""
    columns = {k: time_column(t.frame.columns, wanted) for k, t in tables.items()}
    starts = [_earliest(tables[k].frame[c]) for k, c in columns.items() if c is not None]
    return min((s for s in starts if s is not None), default=None)


def distinct(groups: Mapping[str, Group]) -> dict[str, Group]:
    """Groups in which every signal has a name of its own: ``<group>.<name>`` where several had it."""
    count = Counter(name for g in groups.values() for name in g.signals)
    found = {}
    for key, group in groups.items():
        twice = {n: f"{key}.{n}" for n in group.signals if count[n] > 1}
        if not twice:
            found[key] = group
            continue
        signals = {}
        for name, signal in group.signals.items():
            new = twice.get(name, name)
            known = {"source_name": signal.source_name or name, "flags": (*signal.flags, SHARED_NAME)}
            signals[new] = replace(signal, name=new, **(known if name in twice else {}))  # type: ignore[arg-type]
        found[key] = Group(group.name, group.frame.rename(twice), signals)
    return found


def _clock_column(where: str, table: Table, wanted: TimeMap) -> str | None:
    column = time_column(table.frame.columns, wanted)
    if (
        column is not None
        and column != TIME
        and TIME in table.frame.columns
        and match(wanted.source, [column])
    ):
        raise LogError(
            f"{where}: the map makes {column!r} the time, but there is a {TIME!r} column too; rename it"
        )
    return column


def _earliest(values: pl.Series) -> int | None:
    if not isinstance(values.dtype, pl.Datetime) or values.null_count() == len(values):
        return None
    return int(values.dt.cast_time_unit("ns").to_physical().min())  # type: ignore[arg-type]


def _usable(frame: pl.DataFrame, clock: str | None) -> tuple[pl.DataFrame, list[str]]:
    """The columns that can be signals, in types a log has; words on the others."""
    frame = frame.with_columns(
        pl.col(pl.Categorical, pl.Enum).cast(pl.String),
        pl.col(pl.Decimal, pl.Int128).cast(pl.Float64),
        pl.col(pl.Null).cast(pl.Float64),
    )
    kinds = frame.schema
    good = [c for c, t in kinds.items() if c == clock or t.is_numeric() or t in (pl.Boolean, pl.String)]
    skipped = [f"column {c!r} was skipped: {t}" for c, t in kinds.items() if c not in good]
    return frame.select(good), skipped
