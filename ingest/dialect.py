"""How a text table is written: what stands above the data, separator, decimal sign, names and units.

Benches put lines about the test above the names, and a row of units (or more) below. The row of names is the
one with a time column that is followed by a row of as many fields whose time is a number or a date. A table
that has numbers only gets the names ``c01 c02 ...``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

from ingest.clock import date_column, no_time, split_unit, time_column
from ingest.errors import LogError
from ingest.log import TIME
from ingest.maps import TimeMap
from ingest.units import find_unit

SEPARATORS = (";", "\t", ",", "|", " ")
NAMELESS = "no name in the file"
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")
_DATE = re.compile(r"(\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[T ])?(\d+:)?\d{1,2}:\d\d([.,]\d+)?( ?[AaPp][Mm])?Z?")
_COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
csv.field_size_limit(1 << 30)  # a quote that is never closed makes one field of the rest
_LOOK_AHEAD = 8  # rows between names and data: units, rasters, descriptions
_SEARCHED = 200  # lines in which the row of names is looked for
_SAMPLE = 200  # rows that decide about the decimal sign


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column: its name, unique and ``time`` for the time; the unit with it; its head as written."""

    name: str
    unit: str | None
    written: str


@dataclass(frozen=True, kw_only=True)
class Dialect:
    """``start``: byte at which the data begin. ``time``, ``date``: index of the column of times and of dates
    beside it. ``named``: whether the file has a row of names."""

    separator: str
    decimal_comma: bool
    columns: tuple[Column, ...]
    time: int | None
    date: int | None = None
    named: bool = True
    start: int
    above: tuple[str, ...]


def sniff(where: str, head: bytes, time: TimeMap) -> Dialect:
    """The dialect of a table that begins with ``head`` (UTF-8).

    Raises:
        LogError: no row of names with a time column, or no data below it.
    """
    lines = head.split(b"\n")
    text = [line.decode("utf-8", "replace").rstrip("\r") for line in lines[: _SEARCHED + _SAMPLE]]
    found = [f for sep in SEPARATORS if (f := _find(text, sep, time)) is not None]
    if not found:
        found = [f for sep in SEPARATORS if (f := _numbers_only(text, sep)) is not None]
    if not found:
        raise _not_found(where, text, time)
    separator, at, first = max(found, key=lambda f: len(split(text[f[1]], f[0])))
    named = first > at
    rows = [split(line, separator) for line in text[at:first]]
    sample = [split(line, separator) for line in text[first : first + _SAMPLE]]
    width = len(sample[0])
    names = rows[0] if named else [f"c{i:0{max(2, len(str(width)))}}" for i in range(1, width + 1)]
    chosen = time_column(names, time)
    clock = names.index(chosen) if chosen is not None else None
    day = date_column(names) if clock is not None and re.match(r"\d+:", sample[0][clock]) else None
    return Dialect(
        separator=separator,
        decimal_comma=separator != "," and any(_COMMA_NUMBER.fullmatch(c) for row in sample for c in row),
        columns=_columns(names, _unit_row(rows), width, clock),
        time=clock,
        date=names.index(day) if day is not None else None,
        named=named,
        start=sum(len(line) + 1 for line in lines[:first]),
        above=tuple(text[:at]),
    )


def split(line: str, separator: str) -> list[str]:
    """The fields of a line, stripped; of spaces any number separates."""
    if separator == " ":
        return line.split()
    quoted = '"' in line
    fields = next(csv.reader([line], delimiter=separator), []) if quoted else line.split(separator)
    return [f.strip() for f in fields]


def _find(text: Sequence[str], separator: str, time: TimeMap) -> tuple[str, int, int] | None:
    """Separator, index of the row of names and index of the first row of data."""
    for at, line in enumerate(text[:_SEARCHED]):
        names = split(line, separator)
        if 2 * sum(bool(_NUMBER.fullmatch(n)) for n in names) > len(names):
            continue
        wanted = time_column(names, time) if len(names) > 1 else None
        unnamed = wanted is None
        if unnamed and (time.rate is None or len(names) < 2 or any(map(_NUMBER.fullmatch, names))):
            continue
        for first, below in enumerate(text[at + 1 : at + 1 + _LOOK_AHEAD], at + 1):
            row = split(below, separator)
            fits = len(row) == len(names) or (len(row) == len(names) + 1 and not row[-1])
            clock = row[:1] if unnamed else row[names.index(str(wanted)) :][:1]
            if fits and any(_NUMBER.fullmatch(c) or _DATE.fullmatch(c) for c in clock):
                return separator, at, first
    return None


def _numbers_only(text: Sequence[str], separator: str) -> tuple[str, int, int] | None:
    """The first row, if it and the next have two or more fields that are all numbers."""
    rows = [split(line, separator) for line in text[:2] if line.strip()]
    numbers = all(len(r) > 1 and all(_NUMBER.fullmatch(f) for f in r if f) and any(r) for r in rows)
    return (separator, 0, 0) if rows and numbers and len({len(r) for r in rows}) == 1 else None


def _not_found(where: str, text: Sequence[str], time: TimeMap) -> LogError:
    rows = [(split(line, sep), sep) for sep in SEPARATORS[:-1] for line in text if line.strip()]
    if not rows:
        return LogError(f"{where}: the file is empty; expected a row of names and rows of numbers")
    names, separator = max(rows, key=lambda r: (len(r[0]), not any(_NUMBER.fullmatch(f) for f in r[0])))
    if len(names) < 2:
        return LogError(f"{where}: not a table: no line has two fields separated by one of ; tab , | space")
    if time_column(names, time) is None:
        return no_time(where, names, time)
    return LogError(
        f"{where}: no samples: below the names {separator.join(names)[:60]!r} "
        f"there is no row of {len(names)} fields whose time is a number or a date"
    )


def _unit_row(rows: Sequence[Sequence[str]]) -> Sequence[str]:
    """Of the rows between names and data the one with most known units, if any has one."""
    known = [sum(find_unit(f) is not None for f in row if f) for row in rows[1:]]
    return rows[1 + known.index(max(known))] if any(known) else ()


def _columns(names: Sequence[str], units: Sequence[str], width: int, clock: int | None) -> tuple[Column, ...]:
    columns: list[Column] = []
    taken = {TIME}
    for i in range(width):
        written = names[i] if i < len(names) else ""
        name, unit = split_unit(written)
        unit = (units[i].strip("[] ") if i < len(units) else "") or unit
        unique = name = TIME if i == clock else name or f"column_{i + 1}"
        n = 1
        while unique in taken and i != clock:
            n += 1
            unique = f"{name}_{n}"
        taken.add(unique)
        columns.append(Column(name=unique, unit=unit or None, written=written))
    return tuple(columns)
