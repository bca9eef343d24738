"""Parquet: one row group or more per raster, what is known of a signal in its column's metadata.

A log of several groups is one file: in a group's rows the columns of the others are empty, and the file's
metadata say which rows are whose. To any other tool it is one table with each signal at its own time stamps.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from ingest.about import about_json, parse_about
from ingest.clock import Clock, no_time, time_column
from ingest.errors import LogError
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording

GROUP = "data"
_KEY, _CHECKSUM = b"dynoscope", b"dynoscope.crc32"


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins with Parquet's magic."""
    return head[:4] == b"PAR1"


def header(path: Path, names: NameMap) -> Recording:
    """Channels and row counts from the footer."""
    return _read(path, names, rows=False)


def read(path: Path, names: NameMap) -> Recording:
    """All rows; page checksums are checked where the file has them.

    Raises:
        LogError: damaged, without a time column (foreign files), or without samples.
    """
    return _read(path, names, rows=True)


def _read(path: Path, names: NameMap, *, rows: bool) -> Recording:
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            metadata = file.schema_arrow.metadata or {}
            if _KEY not in metadata and _CHECKSUM not in metadata:
                return Recording(_foreign(path, names, file, rows))
            text = metadata.get(_KEY, b"")
            if metadata.get(_CHECKSUM) != _checksum(file.schema_arrow, text):
                raise LogError(f"{path}: damaged Parquet file: its description has a wrong checksum")
            return Recording(_ours(file, parse_about(str(path), text), rows), ours=True)
    except (pa.ArrowException, OSError) as error:
        raise LogError(f"{path}: damaged Parquet file: {str(error).splitlines()[0]}") from error


def _ours(file: pq.ParquetFile, about: dict[str, Any], rows: bool) -> Log:
    signals = _signals(file.schema_arrow)
    groups, at = {}, 0
    for name, group in about["groups"].items():
        parts, left = [], group["rows"] if rows else 0
        while left > 0:
            parts.append(at)
            left -= file.metadata.row_group(at).num_rows
            at += 1
        columns = [TIME, *group["signals"]]
        frame = _frame(file.read_row_groups(parts, columns=columns)).select(columns)
        groups[name] = Group(name, frame, {c: signals[c] for c in columns[1:]})
    facts = about["facts"]
    if not rows:
        facts = {**facts, "rows": {k: g["rows"] for k, g in about["groups"].items()}}
    return Log(about["name"], groups, tuple(Event(**e) for e in about["events"]), facts)


def _foreign(path: Path, names: NameMap, file: pq.ParquetFile, rows: bool) -> Log:
    schema = file.schema_arrow
    clock = time_column(schema.names, names.time)
    if clock is None:
        raise no_time(str(path), schema.names, names.time)
    everything = range(file.num_row_groups) if rows else ()
    frame = _frame(file.read_row_groups(list(everything)))
    frame = frame.with_columns(
        pl.col(pl.Categorical, pl.Enum).cast(pl.String), pl.col(pl.Decimal).cast(pl.Float64)
    )
    signals = _signals(schema)
    usable = [
        c for c, t in frame.schema.items() if c != clock and (t.is_numeric() or t in (pl.Boolean, pl.String))
    ]
    skipped = [f"column {c!r} was skipped: {t}" for c, t in frame.schema.items() if c not in (clock, *usable)]
    if TIME in usable:
        raise LogError(
            f"{path}: the map makes {clock!r} the time, but there is a {TIME!r} column too; rename it"
        )
    known = Clock(str(path), signals[clock].unit, names.time)
    frame = known.timed(frame.select(clock, *usable), clock)
    facts = known.facts
    if rows and frame.is_empty():
        raise LogError(f"{path}: no samples: no row has a time")
    if notes := [*facts.get("notes", ()), *skipped]:
        facts["notes"] = notes
    if not rows:
        facts["rows"] = {GROUP: file.metadata.num_rows}
    return Log(path.stem, {GROUP: Group(GROUP, frame, {c: signals[c] for c in usable})}, (), facts)


def _frame(table: pa.Table) -> pl.DataFrame:
    frame = pl.from_arrow(table)
    assert isinstance(frame, pl.DataFrame)  # for the type checker: a table is never a series
    return frame


def _signals(schema: pa.Schema) -> dict[str, Signal]:
    pairs = {f.name: {k.decode(): v.decode() for k, v in (f.metadata or {}).items()} for f in schema}
    return {name: Signal.from_metadata(name, known) for name, known in pairs.items()}


def _checksum(schema: pa.Schema, text: bytes) -> bytes:
    """Parquet guards its pages, but not the footer with names, units and our description."""
    fields = [(f.name, str(f.type), sorted((f.metadata or {}).items())) for f in schema]
    return str(zlib.crc32(repr((fields, text)).encode())).encode()


def write(log: Log, path: Path) -> None:
    """One file with zstd compression and page checksums."""
    tables = [g.frame.to_arrow(compat_level=pl.CompatLevel.oldest()) for g in log.groups.values()]
    fields = {f.name: f for table in tables for f in table.schema}
    signals = {TIME: Signal(name=TIME, unit="s"), **log.signals}
    schema = pa.schema([fields[n].with_metadata(s.to_metadata()) for n, s in signals.items() if n in fields])
    text = about_json(log, events=[e.to_json() for e in log.events]).encode()
    schema = schema.with_metadata({_KEY: text, _CHECKSUM: _checksum(schema, text)})
    with pq.ParquetWriter(path, schema, compression="zstd", write_page_checksum=True) as writer:
        for table in tables:
            of_group = dict(zip(table.schema.names, table.columns, strict=True))
            columns = [of_group.get(f.name, pa.nulls(table.num_rows, f.type)) for f in schema]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))
