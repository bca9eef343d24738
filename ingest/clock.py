"""The time column of a table: which one it is, and its values in seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import polars as pl

from ingest.errors import LogError, UnitError, did_you_mean
from ingest.log import TIME
from ingest.maps import TimeMap, match
from ingest.units import conversion, find_unit

TIME_NAMES = (
    "time", "t", "timestamp", "timestamps", "zeit", "zeitstempel", "temps", "tid", "tiempo", "tempo",
    "seconds", "sec", "elapsedtime", "recordertime", "recordingtime", "reltime", "relativetime", "abstime",
)  # fmt: skip
"""Names that mean time whatever their case, spaces and underscores; the first that is there counts."""

_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y")
_BRACKETED = re.compile(r"^(?P<name>.*?\S)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))$")
_UNIT_ENDING = re.compile(r"^(?P<name>.+)[_ ](?P<unit>ns|us|ms|s|sec|min)$", re.IGNORECASE)


def split_unit(header: str) -> tuple[str, str | None]:
    """Name and unit of a column headed such as ``p_Bst [kPa]``; round brackets must hold a known unit.

    >>> split_unit("p_Bst [kPa]"), split_unit("T (°C)"), split_unit("gear (wanted)"), split_unit("x")
    (('p_Bst', 'kPa'), ('T', '°C'), ('gear (wanted)', None), ('x', None))
    """
    found = _BRACKETED.match(header.strip())
    if found and (found["square"] is not None or find_unit(found["round"])):
        return found["name"], (found["square"] or found["round"] or "").strip() or None
    return header.strip(), None


def time_column(columns: Iterable[str], wanted: TimeMap) -> str | None:
    """The column that is time: by the map, else by its name; None if there is none.

    >>> time_column(["p_Bst", "Time Stamp [ms]"], TimeMap())
    'Time Stamp [ms]'
    """
    names = list(columns)
    bare = {split_unit(n)[0]: n for n in reversed(names)}
    mapped = match(wanted.source, names) or [bare[n] for n in match(wanted.source, bare)]
    plain = {_plain(n): n for n in reversed(names)}
    return next((n for n in (*mapped, *(plain.get(t) for t in TIME_NAMES)) if n is not None), None)


def _plain(header: str) -> str:
    name = split_unit(header)[0]
    name = _UNIT_ENDING.sub(r"\g<name>", name)
    return re.sub(r"[\s_.\-#]", "", name).casefold()


def no_time(where: str, columns: Iterable[str], wanted: TimeMap) -> LogError:
    """The error for a table without a time column."""
    looked_for = wanted.source or TIME_NAMES[:6]
    return LogError(
        f"{where}: no time column; looked for {', '.join(looked_for)}; columns: "
        f"{did_you_mean(looked_for[0], columns)}; a map can name it: [time] source = ..."
    )


def to_seconds(where: str, values: pl.Series, unit: str | None, wanted: TimeMap) -> pl.Series:
    """Time stamps as Float64 in s, missing ones NaN.

    The unit is the map's, the file's, the name's ending, else s. Dates count from the earliest of them.

    Raises:
        LogError: the unit is not one of time, or the values are neither numbers nor dates.
    """
    if isinstance(values.dtype, pl.Datetime | pl.Duration):
        ns = values.dt.cast_time_unit("ns").to_physical()
        since = ns - (ns.min() or 0) if isinstance(values.dtype, pl.Datetime) else ns
        return pl.Series(TIME, since.to_numpy() / 1e9)
    ending = _UNIT_ENDING.match(split_unit(values.name)[0])
    unit = wanted.unit or unit or (ending["unit"] if ending else "s")
    try:
        scale, _ = conversion(unit, "s")
    except UnitError as error:
        raise LogError(f"{where}: time column {values.name!r}: {error}") from error
    if not values.dtype.is_numeric():
        example = values.drop_nulls().head(1).to_list()
        raise LogError(f"{where}: time column {values.name!r} holds {example}; expected numbers in {unit}")
    time = values.cast(pl.Float64).to_numpy()
    return pl.Series(TIME, time * scale if scale >= 1 else time / round(1 / scale))  # 300 ms is 0.3, exactly


def parse_dates(text: pl.Series) -> pl.Series:
    """Written dates as Datetime, times of the day as Duration; null where they are neither.

    >>> parse_dates(pl.Series(["2024-05-01T12:00:00.5Z", None])).dt.to_string("%H:%M:%S%.3f").to_list()
    ['12:00:00.500', None]
    >>> to_seconds("x", parse_dates(pl.Series("t", ["00:01:00", "00:01:00,25"])), None, TimeMap()).to_list()
    [60.0, 60.25]
    """
    plain = text.str.strip_suffix("Z").str.replace("T", " ", literal=True).str.replace(",", ".", literal=True)
    day = pl.Series(text.name, [None] * len(text), dtype=pl.Datetime("ns"))
    for form in _DATES:
        day = day.fill_null(plain.str.to_datetime(f"{form} %H:%M:%S%.f", time_unit="ns", strict=False))
    if day.null_count() < len(day):
        return day
    clock = ("1970-01-01 " + plain).str.to_datetime("%Y-%m-%d %H:%M:%S%.f", time_unit="ns", strict=False)
    return clock.to_physical().cast(pl.Duration("ns")).alias(text.name)


def with_time(
    where: str, frame: pl.DataFrame, column: str, unit: str | None, wanted: TimeMap
) -> tuple[pl.DataFrame, dict[str, Any]]:
    """The frame with ``column`` turned into ``time`` in s, without rows that have none; facts about it.

    Raises:
        LogError: see :func:`to_seconds`.
    """
    clock = frame[column]
    time = to_seconds(where, clock, unit, wanted)
    timed = frame.drop(column).with_columns(time).filter(pl.col(TIME).is_finite())
    facts: dict[str, Any] = {}
    if isinstance(clock.dtype, pl.Datetime) and timed.height:
        facts["start_time"] = str(clock.min())
    if lost := frame.height - timed.height:
        facts["notes"] = [f"{lost} rows without a time were dropped"]
    return timed, facts
