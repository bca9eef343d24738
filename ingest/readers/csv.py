"""Text tables as benches and measurement programs write them.

All columns are read as numbers; nothing is inferred from the first rows. Only where cells were not numbers
is the text looked at again: padded and grouped numbers are taken, words for "missing" become null, a column
without any number is a state of words, and what is left over is counted and flagged. Columns that are mostly
empty have a raster of their own, without the empty rows. A last line without line end is dropped: it may be
cut in the middle of a number.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl

from ingest.about import about_json, parse_about
from ingest.blocks import BLOCK_BYTES, join
from ingest.dialect import NAMELESS, Column, Dialect, sniff
from ingest.errors import LogError
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording
from ingest.table import Table
from ingest.text import TextFile

GROUP = "data"
HEAD = 1 << 20
_OWN = b"# dynoscope "
_FEW = 20  # lines at the beginning that must be seen, as long as they are
_LONGEST = 1 << 28
_SPARSE = 0.75  # a column with a smaller share of cells has a raster of its own
_ENOUGH = 50  # rows to judge that by


def is_mine(path: Path, head: bytes) -> bool:
    """Whether ``head`` is text: the format of last resort, which says what is amiss."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return True
    try:
        text = head.rstrip(b"\0").decode()
    except UnicodeDecodeError as error:
        text = head.rstrip(b"\0").decode("latin-1" if error.end < len(head) else "ascii", "ignore")
    return not re.search(r"[\x00-\x08\x0e-\x1f\x7f-\x9f]", text)


def header(path: Path, names: NameMap) -> Recording:
    """Columns, units and types from the first MiB."""
    file = TextFile(path)
    about, dialect, start = _begin(file, names)
    table = Table(path, dialect, names.time)
    frame = table.parse(next(file.blocks(start, HEAD), b""))
    log = _log(path, dialect, frame, {}, about, _began(table), None)
    groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in log.groups.items()}
    return Recording(Log(log.name, groups, log.events, log.facts))


def read(path: Path, names: NameMap) -> Recording:
    """The whole table, values exactly as written (Float64, or String for states).

    Raises:
        LogError: not a table with a time column, no complete row, or most rows have too many fields.
    """
    return Recording(join(part.log for part in blocks(path, names, None)))


def blocks(path: Path, names: NameMap, size: int | None = BLOCK_BYTES) -> Iterator[Recording]:
    """The table in parts; the last one has no rows, but all facts."""
    file = TextFile(path)
    about, dialect, start = _begin(file, names)
    table = Table(path, dialect, names.time)
    rasters: dict[str, list[str]] | None = None
    count, done = 0, start
    part: Recording | None = None
    plain = size is None and dialect.separator != " " and not dialect.decimal_comma
    rest = file.untouched(start) if plain else None
    for body in file.blocks(start, size) if rest is None else [rest]:
        frame = table.parse(body)
        log = _log(path, dialect, frame, table.flags, about, _began(table), rasters)
        rasters = {k: list(g.signals) for k, g in log.groups.items()}
        count += frame.height
        done += len(body)
        part = Recording(log, share=min(1.0, done / path.stat().st_size))
        yield part
    if not count or part is None:
        raise LogError(f"{path}: no samples: no complete row whose time is a number")
    facts = {**part.log.facts, **_facts(file, dialect, table)}
    groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in part.log.groups.items()}
    yield Recording(Log(part.log.name, groups, part.log.events, facts))


def _begin(file: TextFile, names: NameMap) -> tuple[dict[str, Any], Dialect, int]:
    """What :func:`write` put into the first line, the dialect, and the byte at which the data begin."""
    size = HEAD
    head = file.head(size)
    while head.count(b"\n") < _FEW and size <= len(head) < _LONGEST:
        size *= 4
        head = file.head(size)
    about: dict[str, Any] = {}
    skip = 0
    if head.startswith(_OWN):
        line, _, head = head.partition(b"\n")
        skip = len(line) + 1
        about = parse_about(f"{file.path}, first line", line.removeprefix(_OWN))
    dialect = sniff(str(file.path), head.rstrip(b"\0"), names.time)
    return about, dialect, skip + dialect.start


def _began(table: Table) -> dict[str, Any]:
    """What is known from the first row on."""
    return {k: v for k, v in table.clock.facts.items() if k == "start_time"}


def _facts(file: TextFile, dialect: Dialect, table: Table) -> dict[str, Any]:
    """What the whole file has shown."""
    facts = table.clock.facts
    notes = [*file.notes, *facts.pop("notes", ()), *table.notes()]
    salvaged = table.salvaged()
    rest = file.remainder.strip()
    if rest:
        fields = rest.count(dialect.separator.encode()) + 1
        dropped = "the last line has no line end and was dropped: "
        if fields < len(dialect.columns):
            salvaged.append(f"{dropped}{fields} of {len(dialect.columns)} fields")
        else:
            notes.append(f"{dropped}it may be cut in a number")
    if not dialect.named:
        notes.append(f"the file names no channels: they are {dialect.columns[0].name} and so on, in order")
    if dialect.time is None and table.clock.wanted.rate is None:
        notes.append(
            "no time column: rows are counted as 1 s each; [time] rate = ... in a map, or --rate, gives the "
            "rows per second, [time] source = ... a column of time"
        )
    return facts | {k: v for k, v in (("notes", notes), ("salvaged", salvaged)) if v}


def _log(
    path: Path,
    dialect: Dialect,
    frame: pl.DataFrame,
    flags: dict[str, str],
    about: dict[str, Any],
    facts: dict[str, Any],
    rasters: dict[str, list[str]] | None,
) -> Log:
    known = about.get("signals", {})
    signals = {}
    for i, column in enumerate(dialect.columns):
        values = frame[column.name]
        nameless = not column.written and values.null_count() == len(values)
        if i not in (dialect.time, dialect.date) and not nameless:  # a separator at the end of each line
            signals[column.name] = _signal(column, dialect, values, flags, known.get(column.name, {}))
    parts = rasters or {k: g["signals"] for k, g in about.get("groups", {}).items()}
    if sorted(signals) != sorted(c for columns in parts.values() for c in columns):
        parts = _rasters(frame, list(signals))  # also of a file edited since we wrote it
    groups = {}
    for name, columns in parts.items():
        part = frame.select(TIME, *columns)
        if len(parts) > 1:
            part = part.filter(pl.any_horizontal(pl.col(columns).is_not_null()))
        groups[name] = Group(name, part, {c: signals[c] for c in columns})
    above = {"head": list(dialect.above)} if any(dialect.above) else {}
    events = tuple(Event(**e) for e in about.get("events", ()))
    return Log(about.get("name", path.stem), groups, events, {**about.get("facts", {}), **above, **facts})


def _rasters(frame: pl.DataFrame, columns: list[str]) -> dict[str, list[str]]:
    """Columns by raster: those that are mostly empty in the same rows belong together."""
    sparse: dict[bytes, list[str]] = {b"": []}
    for column in columns:
        values = frame[column]
        present = len(values) - values.null_count()
        own = len(values) >= _ENOUGH and 0 < present < _SPARSE * len(values)
        sparse.setdefault(values.is_not_null().to_numpy().tobytes() if own else b"", []).append(column)
    members = [m for m in sparse.values() if m] or [[]]
    return {GROUP if i == 0 else f"{GROUP}_{i + 1}": m for i, m in enumerate(members)}


def _signal(
    column: Column, dialect: Dialect, values: pl.Series, flags: dict[str, str], known: dict[str, str]
) -> Signal:
    state = values.dtype == pl.String
    found = (flags.get(column.name), None if dialect.named else NAMELESS)
    signal = Signal(
        name=column.name,
        unit=column.unit,
        kind="state" if state else "continuous",
        resample="hold" if state else "linear",
        source_name=column.written if column.written != column.name else None,
        flags=tuple(f for f in found if f),
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
