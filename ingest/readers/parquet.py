"""Parquet: one row group or more per raster, what is known of a signal in its column's metadata.

A log of several groups is one file: in a group's rows the columns of the others are empty, and the file's
metadata say which row groups are whose. To any other tool it is one table with each signal at its own time
stamps.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from ingest.about import about_json, parse_about, with_flags
from ingest.blocks import BLOCK_BYTES
from ingest.errors import LogError
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording, check_declared
from ingest.tables import Table, earliest, log_of_tables

GROUP = "data"
_KEY, _CHECKSUM = b"dynoscope", b"dynoscope.crc32"
_BLOCK_ROWS = 1 << 18


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


def blocks(path: Path, names: NameMap) -> Iterator[Recording]:
    """The row groups one by one; of a foreign file, as many rows at a time as make :data:`BLOCK_BYTES`."""
    with _opened(path) as file:
        if about := _about(path, file):
            for i, name in enumerate(about["row_groups"] or [""]):
                log = _ours(file, about, {name: [i]} if name else {})
                yield Recording(log, ours=True, share=(i + 1) / max(1, len(about["row_groups"])))
            return
        size = max(1, BLOCK_BYTES // (8 * max(1, file.metadata.num_columns)))
        start: int | None = None
        done = 0
        for batch in file.iter_batches(size):
            frame = frame_of(pa.Table.from_batches([batch]))
            tables = {GROUP: Table(frame, signals_of(file.schema_arrow))}
            start = earliest(tables, names.time) if start is None else start
            done += frame.height
            log = log_of_tables(str(path), path.stem, tables, names.time, start)
            yield Recording(log, share=done / file.metadata.num_rows)
        if not done:
            yield Recording(_foreign(path, names, file, rows=True))  # says what is wrong


def _read(path: Path, names: NameMap, *, rows: bool) -> Recording:
    with _opened(path) as file:
        if rows:
            check_declared(path, file.metadata.num_rows, file.metadata.num_columns)
        about = _about(path, file)
        if not about:
            return Recording(_foreign(path, names, file, rows))
        members = defaultdict[str, list[int]](list)
        for i, name in enumerate(about["row_groups"]) if rows else ():
            members[name].append(i)
        log = _ours(file, about, members)
        if not rows:
            counts = {k: g["rows"] for k, g in about["groups"].items()}
            log = replace(log, facts={**log.facts, "rows": counts})
        return Recording(log, ours=True)


@contextmanager
def _opened(path: Path) -> Iterator[pq.ParquetFile]:
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            yield file
    except (pa.ArrowException, OSError) as error:
        raise LogError(f"{path}: damaged Parquet file: {str(error).splitlines()[0]}") from error


def _about(path: Path, file: pq.ParquetFile) -> dict[str, Any]:
    """What we noted on the whole; empty for a file of others."""
    metadata = file.metadata.metadata or {}
    if _KEY not in metadata and not _names_us(path):
        return {}
    text = metadata.get(_KEY, b"")
    if metadata.get(_CHECKSUM) != _checksum(file.schema_arrow, text):
        raise LogError(f"{path}: damaged Parquet file: its description has a wrong checksum")
    return parse_about(str(path), text)


def _names_us(path: Path) -> bool:
    """Whether the footer holds our key, even where damage keeps the library from finding it."""
    with path.open("rb") as file:
        file.seek(-8, 2)
        size = int.from_bytes(file.read(4), "little")
        file.seek(-8 - size, 2)
        footer = file.read(size)
    return _CHECKSUM in footer or footer.count(_KEY) > 1


def _ours(file: pq.ParquetFile, about: dict[str, Any], members: Mapping[str, list[int]]) -> Log:
    """The log with those row groups of each group that ``members`` names."""
    pairs = {
        f.name: {k.decode(): v.decode() for k, v in (f.metadata or {}).items()} for f in file.schema_arrow
    }
    groups = {}
    for name, group in about["groups"].items():
        columns = [TIME, *group["signals"]]
        frame = frame_of(file.read_row_groups(members.get(name, []), columns=columns)).select(columns)
        signals = {c: Signal.from_metadata(c, pairs[c]) for c in columns[1:]}
        groups[name] = Group(name, frame, with_flags(signals, about))
    return Log(about["name"], groups, tuple(Event(**e) for e in about["events"]), about["facts"])


def _foreign(path: Path, names: NameMap, file: pq.ParquetFile, rows: bool) -> Log:
    everything = range(file.num_row_groups) if rows else ()
    frame = frame_of(file.read_row_groups(list(everything)))
    log = log_of_tables(
        str(path), path.stem, {GROUP: Table(frame, signals_of(file.schema_arrow))}, names.time
    )
    if rows and not log.groups[GROUP].frame.height:
        raise LogError(f"{path}: no samples: no row has a time")
    more = {} if rows else {"rows": {GROUP: file.metadata.num_rows}}
    return Log(log.name, log.groups, log.events, {**log.facts, **more})


def frame_of(table: pa.Table) -> pl.DataFrame:
    """An Arrow table as a frame."""
    frame = pl.from_arrow(table)
    assert isinstance(frame, pl.DataFrame)  # for the type checker: a table is never a series
    return frame


def signals_of(schema: pa.Schema) -> dict[str, Signal]:
    """Unit and description of each column, where the file has them."""
    found = {}
    for field in schema:
        known = {
            k.decode(errors="replace"): v.decode(errors="replace") for k, v in (field.metadata or {}).items()
        }
        unit, description = known.get("unit") or known.get("units") or None, known.get("description", "")
        found[field.name] = Signal(name=field.name, unit=unit, description=description)
    return found


def _checksum(schema: pa.Schema, text: bytes) -> bytes:
    """Parquet guards its pages, but not the footer with names, units and our description."""
    fields = [(f.name, str(f.type), sorted((f.metadata or {}).items())) for f in schema]
    return str(zlib.crc32(repr((fields, text)).encode())).encode()


class Recorder:
    """Writes a log part by part: zstd compression, page checksums, one row group per part and raster."""

    def __init__(self, path: Path, first: Log) -> None:
        tables = [_arrow(g.frame.clear()) for g in first.groups.values()]
        fields = {f.name: f for table in tables for f in table.schema}
        signals = {TIME: Signal(name=TIME, unit="s"), **first.signals}
        self.schema = pa.schema(
            [fields[n].with_metadata(s.to_metadata()) for n, s in signals.items() if n in fields]
        )
        # measurements rarely repeat, so a dictionary of them costs time and space
        words = [f.name for f in self.schema if not pa.types.is_floating(f.type)]
        self.writer = pq.ParquetWriter(
            path, self.schema, compression="zstd", use_dictionary=words or False, write_page_checksum=True
        )
        self.row_groups: list[str] = []
        self.counts = dict.fromkeys(first.groups, 0)

    def add(self, part: Log) -> None:
        for name, group in part.groups.items():
            for start in range(0, group.frame.height, _BLOCK_ROWS):
                table = _arrow(group.frame.slice(start, _BLOCK_ROWS))
                given = dict(zip(table.schema.names, table.columns, strict=True))
                columns = [given.get(f.name, pa.nulls(table.num_rows, f.type)) for f in self.schema]
                self.writer.write_table(pa.Table.from_arrays(columns, schema=self.schema))
                self.row_groups.append(name)
                self.counts[name] += table.num_rows

    def finish(self, whole: Log, attachments: Mapping[str, bytes]) -> None:
        """Writes what is known of the whole; Parquet has no place for attachments."""
        events = [e.to_json() for e in whole.events]
        text = about_json(whole, self.counts, events=events, row_groups=self.row_groups).encode()
        self.writer.add_key_value_metadata({_KEY: text, _CHECKSUM: _checksum(self.schema, text)})
        self.close()

    def close(self) -> None:
        self.writer.close()


def _arrow(frame: pl.DataFrame) -> pa.Table:
    return frame.to_arrow(compat_level=pl.CompatLevel.oldest())
