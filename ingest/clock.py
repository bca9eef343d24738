"""The time column of a table: which one it is, and its values in seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from ingest.errors import LogError, UnitError, did_you_mean
from ingest.log import TIME
from ingest.maps import TimeMap, match
from ingest.units import conversion, find_unit

TIME_NAMES = (
    "time", "t", "timestamp", "timestamps", "zeit", "zeitstempel", "temps", "tid", "tiempo", "tempo",
    "seconds", "sec", "elapsedtime", "recordertime", "recordingtime", "reltime", "relativetime", "abstime",
    "datetime", "dateandtime", "datumzeit", "uhrzeit", "timeofday",
)  # fmt: skip
"""Names that mean time whatever their case, spaces and underscores; the first that is there counts."""
DATE_NAMES = ("date", "datum", "day")
"""Names of a column of dates beside one of times of the day."""

_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y")
_TIMES = ("%H:%M:%S%.f", "%I:%M:%S%.f %p", "%H:%M")
_SLOW = 5.0  # s; few benches record so rarely, and many write ms
_ENOUGH, _JUDGED = 10, 10_000  # rows to judge that by, at least and at most
_BRACKETED = re.compile(r"^(?P<name>.*?\S)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))$")
_UNIT_ENDING = re.compile(r"^(?P<name>.+)[_ ](?P<unit>ns|us|ms|s|sec|min)$", re.IGNORECASE)
_ELAPSED = r"^(?:(?P<h>\d+):)?(?P<m>\d+):(?P<s>\d\d?(?:\.\d+)?)$"


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


def date_column(columns: Iterable[str]) -> str | None:
    """The column of dates, if one has such a name."""
    return next((n for n in columns if _plain(n) in DATE_NAMES), None)


def _plain(header: str) -> str:
    name = split_unit(header)[0]
    name = _UNIT_ENDING.sub(r"\g<name>", name)
    return re.sub(r"[\s_.\-#]", "", name).casefold()


def no_time(where: str, columns: Iterable[str], wanted: TimeMap) -> LogError:
    """The error for a table without a time column."""
    looked_for = wanted.source or TIME_NAMES[:6]
    return LogError(
        f"{where}: no time column; looked for {', '.join(looked_for)}; columns: "
        f"{did_you_mean(looked_for[0], columns)}; a map can name it: [time] source = ..., "
        "or give the rows per second: [time] rate = ..."
    )


def iso(ns: int) -> str:
    """Date and time of ``ns`` since 1970.

    >>> iso(1_500_000_000)
    '1970-01-01T00:00:01.5'
    """
    whole, _, part = str(np.datetime64(ns, "ns")).partition(".")
    return f"{whole}.{part}".rstrip("0").rstrip(".")


@dataclass
class Clock:
    """Time stamps in s of one table, given whole or in blocks of rows.

    The unit is the map's, the file's (``unit``), the name's ending, else s. Dates count from the earliest of
    the first block. Without a time column, rows are counted at the map's ``rate`` (else 1 Hz, and told).
    """

    where: str
    unit: str | None
    wanted: TimeMap
    start_ns: int | None = None
    rows: int = 0
    lost: int = 0
    slow_step: float = 0.0  # of a time without any unit, where that makes one wonder

    @property
    def facts(self) -> dict[str, Any]:
        """What is known now: ``start_time``, and ``notes`` on rows that were dropped."""
        facts: dict[str, Any] = {}
        if self.start_ns is not None:
            facts["start_time"] = iso(self.start_ns)
        notes = [f"{self.lost} rows without a time were dropped"] if self.lost else []
        if self.slow_step:
            notes.append(
                f"the time has no unit and was taken as s, {self.slow_step:g} s from row to row; if not so, "
                'a map says so: [time] unit = "ms"'
            )
        return facts | ({"notes": notes} if notes else {})

    def timed(self, frame: pl.DataFrame, column: str) -> pl.DataFrame:
        """``frame`` with ``column`` turned into ``time``, without rows that have none.

        Raises:
            LogError: see :meth:`seconds`.
        """
        timed = frame.drop(column).with_columns(self.seconds(frame[column]))
        present = timed[TIME].is_finite()
        if not present.all():
            timed = timed.filter(present)
        self.lost += frame.height - timed.height
        return timed

    def counted(self, frame: pl.DataFrame) -> pl.DataFrame:
        """``frame`` with the time of its rows, counted from 0 at the map's rate."""
        rows = np.arange(self.rows, self.rows + frame.height)
        self.rows += frame.height
        return frame.with_columns(pl.Series(TIME, rows / (self.wanted.rate or 1.0)))

    def seconds(self, values: pl.Series) -> pl.Series:
        """Time stamps as Float64 in s, missing ones NaN.

        Raises:
            LogError: the unit is not one of time, or the values are neither numbers nor dates.
        """
        if isinstance(values.dtype, pl.Datetime | pl.Duration):
            ns = values.dt.cast_time_unit("ns").to_physical()
            if isinstance(values.dtype, pl.Datetime):
                earliest: Any = ns.min()
                self.start_ns = earliest if self.start_ns is None else self.start_ns
                ns = ns - (self.start_ns or 0)
            return pl.Series(TIME, ns.to_numpy() / 1e9)
        name = split_unit(values.name)[0]
        ending = _UNIT_ENDING.match(name)
        unit = self.wanted.unit or self.unit or (ending["unit"] if ending else "s")
        try:
            scale, _ = conversion(unit, "s")
        except UnitError as error:
            raise LogError(f"{self.where}: time column {values.name!r}: {error}") from error
        if not values.dtype.is_numeric():
            example = values.drop_nulls().head(1).to_list()
            raise LogError(
                f"{self.where}: time column {values.name!r} holds {example}; expected numbers in {unit}"
            )
        time = values.cast(pl.Float64).to_numpy()
        if not (self.wanted.unit or self.unit or ending) and len(time) >= _ENOUGH:
            few = np.abs(np.diff(time[:_JUDGED]))
            step = float(np.nanmedian(few)) if np.isfinite(few).any() else 0.0
            self.slow_step = step if step >= _SLOW else 0.0
        exact = time * scale if scale >= 1 else time / round(1 / scale)  # 300 ms is 0.3, exactly
        ends = np.cumsum(values.chunk_lengths())[:-1]  # a frame is copied where its columns' chunks differ
        return pl.concat([pl.Series(TIME, part) for part in np.split(exact, ends)])


def parse_dates(text: pl.Series) -> pl.Series:
    """Written dates as Datetime, times of the day or elapsed ones as Duration; null where they are neither.

    Where the day and the month could be either way round, the one that spans less time is taken.

    >>> parse_dates(pl.Series(["2024-05-01T12:00:00.5Z", None])).dt.to_string("%H:%M:%S%.3f").to_list()
    ['12:00:00.500', None]
    >>> elapsed = parse_dates(pl.Series("t", ["00:01:00", "25:01:00,25"]))
    >>> Clock("x", None, TimeMap()).seconds(elapsed).to_list()
    [60.0, 90060.25]
    """
    plain = text.str.strip_suffix("Z").str.replace("T", " ", literal=True).str.replace(",", ".", literal=True)
    forms = [f"{date} {time}" for date in _DATES for time in _TIMES]
    read = (plain.str.to_datetime(f, time_unit="ns", strict=False) for f in forms)
    days = [d for d in read if d.null_count() < len(d)]
    if days:
        return min(days, key=lambda d: (d.null_count(), _span(d))).alias(text.name)
    parts = plain.str.extract_groups(_ELAPSED).struct
    h, m, s = (parts.field(f).cast(pl.Float64) for f in "hms")
    seconds = h.fill_null(0.0) * 3600 + m * 60 + s
    return (seconds * 1e9).round().cast(pl.Int64).cast(pl.Duration("ns")).alias(text.name)


def _span(days: pl.Series) -> int:
    ns = days.to_physical()
    return int(ns.max()) - int(ns.min())  # type: ignore[arg-type]
