"""The rows of a text table, block by block: parsing, and the second look at cells that were not numbers."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.clock import Clock, parse_dates
from ingest.dialect import Dialect, split
from ingest.errors import LogError
from ingest.log import TIME
from ingest.maps import TimeMap
from ingest.numbers import numbers, strip
from ingest.text import Untouched

_LONG = 0.01  # share of rows with too many fields from which on the dialect must be wrong


@dataclass
class Table:
    """Parser of one file; remembers between blocks what it found."""

    path: Path
    dialect: Dialect
    wanted: TimeMap
    flags: dict[str, str] = field(default_factory=dict)
    states: set[str] | None = None
    odd: Counter[str] = field(default_factory=Counter)
    short: int = 0
    long: int = 0
    first_long: str = ""
    rows: int = 0

    def __post_init__(self) -> None:
        time = self.dialect.time
        self.names = [c.name for c in self.dialect.columns]
        unit = None if time is None else self.dialect.columns[time].unit
        self.clock = Clock(str(self.path), unit, self.wanted)

    def parse(self, body: bytes | Untouched) -> pl.DataFrame:
        """The rows of ``body`` with their time in s; numbers as Float64, states as String.

        Raises:
            LogError: not readable at all.
        """
        if self.dialect.separator == " ":
            body = body if isinstance(body, bytes) else body.text
            body = re.sub(rb"[ \t]+", b" ", body).replace(b"\n ", b"\n").replace(b" \n", b"\n").lstrip(b" ")
        frame, body = self._numbers(body)
        lines = Lines(body, frame.height)
        if frame.width and (last := frame[frame.columns[-1]]).null_count():
            self.short += self._short_rows(lines, last.is_null().arg_true())
        frame = self._second_look(lines, frame)
        empty = frame[frame.columns[0]].is_null()
        if empty.any():
            frame = frame.filter(~pl.all_horizontal(pl.all().is_null()))
        if self.dialect.time is None:
            return self.clock.counted(frame)
        written = self.dialect.columns[self.dialect.time].written
        written = written if written not in frame.columns else TIME
        return self.clock.timed(frame.rename({TIME: written}), written)

    def notes(self) -> list[str]:
        """What was amiss, for the log's facts."""
        found = [f"{n}: {count} {self.flags[n]}" for n, count in self.odd.items()]
        width = len(self.names) - (not self.dialect.columns[-1].written)
        return found + ([f"{self.short} rows have fewer fields than the {width} names"] if self.short else [])

    def salvaged(self) -> list[str]:
        """What was lost."""
        return [f"{self.long} rows have too many fields and were dropped: {self.first_long}"] * bool(
            self.long
        )

    def _numbers(self, body: bytes | Untouched) -> tuple[pl.DataFrame, bytes | Untouched]:
        """All columns as numbers, and the body without rows that do not fit."""
        try:
            frame = self._read(body, pl.Float64)
        except pl.exceptions.ComputeError as error:
            body = body if isinstance(body, bytes) else body.text
            body = self._without_long_rows(body, self.rows + self.long, error)
            frame = self._read(body, pl.Float64)
        self.rows += frame.height
        return frame, body

    def _read(self, body: bytes | Untouched, dtype: type[pl.DataType], *only: int) -> pl.DataFrame:
        source, skip = (body.path, body.lines) if isinstance(body, Untouched) else (body, 0)
        return pl.read_csv(
            source,
            skip_lines=skip,
            has_header=False,
            schema=dict.fromkeys(self.names, dtype),
            columns=list(only) or None,
            separator=self.dialect.separator,
            decimal_comma=self.dialect.decimal_comma,
            ignore_errors=True,
            encoding="utf8-lossy",
        )

    def _without_long_rows(self, body: bytes, before: int, error: Exception) -> bytes:
        separator, width = self.dialect.separator, len(self.names)
        lines = body.split(b"\n")
        mark = separator.encode()
        doubtful = [i for i, line in enumerate(lines) if line.count(mark) >= width]
        long = {
            i: n
            for i in doubtful
            if (n := len(split(lines[i].decode("utf-8", "replace"), separator))) > width
        }
        if not long:
            raise LogError(f"{self.path}: not a readable table: {error}") from error
        at = next(iter(long))
        told = (
            f"row {before + at + 1} of the data has {long[at]} fields, but there are {width} names; "
            f"the separator is {separator!r}: {lines[at][:60].decode('utf-8', 'replace')!r}"
        )
        if len(long) > max(1, _LONG * len(lines)):
            raise LogError(f"{self.path}: {told}") from error
        self.first_long = self.first_long or told
        self.long += len(long)
        return b"\n".join(line for i, line in enumerate(lines) if i not in long)

    def _short_rows(self, lines: Lines, doubtful: pl.Series) -> int:
        """Rows with fewer fields than names; they read as if the last cells were empty. ``doubtful``: rows
        without a last cell."""
        if b'"' in lines.body:
            return 0  # a quoted separator is none
        body, _ = lines.pick(doubtful)
        characters = np.frombuffer(body, np.uint8)
        ends = np.flatnonzero(characters == ord("\n"))
        separators = np.flatnonzero(characters == ord(self.dialect.separator))
        fields = np.diff(np.searchsorted(separators, ends), prepend=0) + 1
        blank = np.diff(ends, prepend=-1) <= 2
        width = len(self.names) - (not self.dialect.columns[-1].written)
        return int(((fields < width) & ~blank).sum())

    def _second_look(self, lines: Lines, frame: pl.DataFrame) -> pl.DataFrame:
        """Columns with cells that were not numbers, read again as text."""
        first = self.states is None
        states = self.states = self.states or set()
        points = self.dialect.decimal_comma and b"." in lines.body  # the parser takes 1.234 for 1,234
        doubtful = [i for i, n in enumerate(self.names) if points or n in states or frame[n].null_count()]
        if not doubtful:
            return frame
        body, rows = lines.body, pl.int_range(frame.height, dtype=pl.UInt32, eager=True)
        if not points and not states:
            rows = frame.select(pl.any_horizontal(pl.nth(doubtful).is_null())).to_series().arg_true()
            body, rows = lines.pick(rows)
        cells = {c.name: c for c in self._read(body, pl.String, *doubtful)}
        for name, text in cells.items():
            number = frame[name].gather(rows)
            number = number.set(text.str.contains(".", literal=True), None) if points else number
            odd = number.is_null().arg_true()
            seen = strip(text.gather(odd))
            read = numbers(seen, decimal_comma=self.dialect.decimal_comma)
            words = seen.filter(read.is_null() & seen.is_not_null())
            none = len(odd) == frame.height and read.null_count() == len(read)
            if name == TIME and none:
                number = parse_dates(self._with_date(seen, cells))
            elif name in states or (first and len(words) and none):
                states.add(name)
                number = strip(text)
            else:
                number = frame[name].scatter(rows.gather(odd), read)
                if len(words):
                    self._tell(name, words)
            frame = frame.with_columns(number.alias(name))
        return frame

    def _with_date(self, text: pl.Series, cells: dict[str, pl.Series]) -> pl.Series:
        """Times of the day with the dates of the column beside them."""
        date = self.dialect.date
        return text if date is None else (strip(cells[self.names[date]]) + " " + text).alias(text.name)

    def _tell(self, name: str, words: pl.Series) -> None:
        example = Counter(words.to_list()).most_common(1)[0][0]
        self.flags.setdefault(name, f"cells are not numbers, such as {example!r}")
        self.odd[name] += len(words)


@dataclass
class Lines:
    """A text of ``height`` rows, line by line."""

    source: bytes | Untouched
    height: int

    @property
    def body(self) -> bytes:
        return self.source if isinstance(self.source, bytes) else self.source.text

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        return np.flatnonzero(np.frombuffer(self.body, np.uint8) == ord("\n")) + 1

    def pick(self, rows: pl.Series) -> tuple[bytes, pl.Series]:
        """The text of these rows, where they are few and every line is a row, else of all; and which they
        are."""
        if len(rows) * 10 >= self.height or b'"' in self.body or len(self._ends) != self.height:
            return self.body, pl.int_range(self.height, dtype=pl.UInt32, eager=True)
        at = rows.to_numpy().astype(np.int64)
        begins = np.where(at > 0, self._ends[at - 1], 0).tolist()
        return b"".join(self.body[a:b] for a, b in zip(begins, self._ends[at].tolist(), strict=True)), rows
