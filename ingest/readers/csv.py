"""Text tables as benches and measurement programs write them.

All columns are read as numbers; nothing is inferred from the first rows. Only where cells were not numbers
is the text looked at again: padded numbers are taken, words for "missing" become null, a column without any
number is a state of words, and what is left over is counted and flagged. A last line without line end is
dropped: it may be cut in the middle of a number.
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ingest.about import about_json, parse_about
from ingest.clock import parse_dates, with_time
from ingest.dialect import Column, Dialect, sniff
from ingest.errors import LogError
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording

GROUP = "data"
HEAD = 1 << 16
MISSING = (
    "", "nan", "-nan", "na", "n/a", "null", "none", "nil", "-", "--", "---", "*", "?", "#n/a", "#nv",
    "#null!", "#div/0!", "#value!", "#ref!", "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "1.#inf", "-1.#inf",
    "invalid",
)  # fmt: skip
"""Cells that say "no value", in any case."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_OWN = b"# dynoscope "


def is_mine(path: Path, head: bytes) -> bool:
    """Whether ``head`` is text: the format of last resort, which says what is amiss."""
    if head[:2] in _UTF_16:
        return True
    try:
        text = head.rstrip(b"\0").decode()
    except UnicodeDecodeError as error:
        text = head.rstrip(b"\0").decode("latin-1" if error.end < len(head) else "ascii", "ignore")
    return not re.search(r"[\x00-\x08\x0e-\x1f\x7f-\x9f]", text)


def header(path: Path, names: NameMap) -> Recording:
    """Columns and units from the first 64 KiB."""
    with path.open("rb") as file:
        first = file.readline(HEAD)
        first += file.readline() if first.startswith(_OWN) else b""
        about, head = _about(path, _as_utf8(first + file.read(HEAD))[0])
    dialect = sniff(str(path), head[:HEAD], names.time)
    schema = dict.fromkeys((c.name for c in dialect.columns), pl.Float64)
    return Recording(_log(path, dialect, pl.DataFrame(schema=schema), {}, about, {}))


def read(path: Path, names: NameMap) -> Recording:
    """The whole table as one group, values exactly as written (Float64, or String for states).

    Raises:
        LogError: not a table with a time column, no complete row, or a row with more fields than names.
    """
    data, notes = _as_utf8(path.read_bytes())
    about, data = _about(path, data)
    dialect = sniff(str(path), data[:HEAD], names.time)
    body, facts = _whole_lines(data[dialect.start :], dialect)
    frame, flags = _second_look(path, body, dialect, _parse(path, body, dialect, pl.Float64))
    if frame[frame.columns[-1]].null_count():
        notes += _short_rows(body, dialect)
    clock = dialect.columns[dialect.time]
    written = clock.written if clock.written not in frame.columns else TIME
    frame = frame.filter(~pl.all_horizontal(pl.all().is_null())).rename({TIME: written})
    frame, told = with_time(str(path), frame, written, clock.unit, names.time)
    if frame.is_empty():
        raise LogError(f"{path}: no samples: no complete row whose time is a number")
    notes += [*facts.pop("notes", ()), *told.pop("notes", ())]
    facts |= told | ({"notes": notes} if notes else {})
    return Recording(_log(path, dialect, frame, flags, about, facts))


def _about(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """What :func:`write` put into the first line, and the rest of the file."""
    if not data.startswith(_OWN):
        return {}, data
    line, _, rest = data.partition(b"\n")
    return parse_about(f"{path}, first line", line.removeprefix(_OWN)), rest


def _as_utf8(data: bytes) -> tuple[bytes, list[str]]:
    """Text as UTF-8 without byte order mark, and notes on what had to be done."""
    if data[:2] in _UTF_16:
        data = data[: len(data) // 2 * 2].decode("utf-16", "replace").encode()
    data = data.removeprefix(b"\xef\xbb\xbf")
    notes = []
    if data.endswith(b"\0"):
        data = data.rstrip(b"\0")
        notes.append("zero bytes at the end, as a crashed logger leaves them, were dropped")
    try:
        data[:HEAD].decode()
    except UnicodeDecodeError as error:
        if error.end < min(HEAD, len(data)):  # else only the last character is cut
            data = data.decode("latin-1").encode()
    return data, notes


def _whole_lines(body: bytes, dialect: Dialect) -> tuple[bytes, dict[str, list[str]]]:
    """The lines that have an end, and facts about one that has none."""
    if body.endswith(b"\n") or not body:
        return body, {}
    end = body.rfind(b"\n") + 1
    fields = body[end:].count(dialect.separator.encode()) + 1
    dropped = "the last line has no line end and was dropped: "
    if fields < len(dialect.columns):
        return body[:end], {"salvaged": [f"{dropped}{fields} of {len(dialect.columns)} fields"]}
    return body[:end], {"notes": [f"{dropped}it may be cut in a number"]}


def _short_rows(body: bytes, dialect: Dialect) -> list[str]:
    """A note on rows with fewer fields than names; they read as if the last cells were empty."""
    if b'"' in body:
        return []  # a quoted separator is none
    characters = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero(characters == ord("\n"))
    separators = np.flatnonzero(characters == ord(dialect.separator))
    fields = np.diff(np.searchsorted(separators, ends), prepend=0) + 1
    blank = np.diff(ends, prepend=-1) <= 2
    width = len(dialect.columns) - (not dialect.columns[-1].written)
    short = int(((fields < width) & ~blank).sum())
    return [f"{short} rows have fewer fields than the {width} names"] if short else []


def _parse(path: Path, body: bytes, dialect: Dialect, dtype: type[pl.DataType], *only: int) -> pl.DataFrame:
    try:
        return pl.read_csv(
            body,
            has_header=False,
            schema=dict.fromkeys((c.name for c in dialect.columns), dtype),
            columns=list(only) or None,
            separator=dialect.separator,
            decimal_comma=dialect.decimal_comma,
            ignore_errors=True,
            encoding="utf8-lossy",
        )
    except pl.exceptions.ComputeError as error:
        raise _ragged(path, body, dialect) or LogError(f"{path}: not a readable table: {error}") from error


def _ragged(path: Path, body: bytes, dialect: Dialect) -> LogError | None:
    width = len(dialect.columns)
    for number, line in enumerate(body.split(b"\n"), 1):
        fields = line.count(dialect.separator.encode()) + 1
        if fields > width and b'"' not in line:
            return LogError(
                f"{path}: row {number} of the data has {fields} fields, but there are {width} names; "
                f"the separator is {dialect.separator!r}: {line[:60].decode('utf-8', 'replace')!r}"
            )
    return None


def _second_look(
    path: Path, body: bytes, dialect: Dialect, frame: pl.DataFrame
) -> tuple[pl.DataFrame, dict[str, str]]:
    """Columns with cells that were not numbers, read again as text; flags by column."""
    flags = {}
    doubtful = [i for i, c in enumerate(frame.columns) if frame[c].null_count()]
    for text in _parse(path, body, dialect, pl.String, *doubtful).get_columns() if doubtful else ():
        text = text.str.strip_chars()
        text = text.set(text.str.to_lowercase().is_in(MISSING), None)
        plain = text.str.replace(",", ".", literal=True) if dialect.decimal_comma else text
        number = frame[text.name].fill_null(plain.cast(pl.Float64, strict=False))
        words = text.filter(number.is_null() & text.is_not_null())
        if len(words) and number.null_count() == len(number):
            number = parse_dates(text) if text.name == TIME else text
        elif len(words):
            example = Counter(words.to_list()).most_common(1)[0][0]
            flags[text.name] = f"{len(words)} cells are not numbers, such as {example!r}"
        frame = frame.with_columns(number)
    return frame, flags


def _log(
    path: Path,
    dialect: Dialect,
    frame: pl.DataFrame,
    flags: dict[str, str],
    about: dict[str, Any],
    facts: dict[str, Any],
) -> Log:
    known = about.get("signals", {})
    signals = {}
    for column in dialect.columns:
        values = frame[column.name]
        nameless = not column.written and values.null_count() == len(values)
        if column.name != TIME and not nameless:  # a separator at the end of each line makes a nameless one
            signals[column.name] = _signal(column, values, flags, known.get(column.name, {}))
    parts = {k: g["signals"] for k, g in about.get("groups", {GROUP: {"signals": list(signals)}}).items()}
    if sorted(signals) != sorted(c for columns in parts.values() for c in columns):
        parts = {GROUP: list(signals)}  # edited since we wrote it
    groups = {}
    for name, columns in parts.items():
        part = frame.select(TIME, *columns)
        if len(parts) > 1:
            part = part.filter(pl.any_horizontal(pl.col(columns).is_not_null()))
        groups[name] = Group(name, part, {c: signals[c] for c in columns})
    above = {"head": list(dialect.above)} if any(dialect.above) else {}
    facts = {**about.get("facts", {}), **above, **facts}
    events = tuple(Event(**e) for e in about.get("events", ()))
    return Log(about.get("name", path.stem), groups, events, facts)


def _signal(column: Column, values: pl.Series, flags: dict[str, str], known: dict[str, str]) -> Signal:
    state = values.dtype == pl.String
    signal = Signal(
        name=column.name,
        unit=column.unit,
        kind="state" if state else "continuous",
        resample="hold" if state else "linear",
        source_name=column.written if column.written != column.name else None,
        flags=(flags[column.name],) if column.name in flags else (),
    )
    return Signal.from_metadata(column.name, {**signal.to_metadata(), **known})


def write(log: Log, path: Path) -> None:
    """One table: a comment line with units, events and facts as JSON, the names, the numbers.

    Groups of several rasters become one table over the union of their time stamps, empty where a group has
    no row; numbers come back exactly, but as Float64 (truth values as 1 and 0).
    """
    with path.open("wb") as file:
        events = [e.to_json() for e in log.events]
        signals = {n: s.to_metadata() for n, s in log.signals.items()}
        file.write(_OWN + about_json(log, events=events, signals=signals).encode() + b"\n")
        table = _union([g.frame for g in log.groups.values()])
        table.with_columns(pl.col(pl.Boolean).cast(pl.UInt8)).write_csv(file)


def _union(frames: list[pl.DataFrame]) -> pl.DataFrame:
    if len(frames) < 2:
        return pl.concat(frames) if frames else pl.DataFrame(schema={TIME: pl.Float64})
    repeat = "\0"  # counts rows of one time stamp; no signal has this name
    keyed = [f.with_columns(pl.int_range(pl.len()).over(TIME).alias(repeat)) for f in frames]
    return pl.concat(keyed, how="align_full").sort(TIME, repeat).drop(repeat)
