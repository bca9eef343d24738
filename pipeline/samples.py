"""Samples that do not fit into memory: written block by block, read back a column or some rows at a time."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ingest.log import TIME
from ingest.readers.parquet import frame_of
from stages.results import DETECTION

BYTES = 1 << 23  # of a row group in memory, about
DRAWN = 20_000  # rows that are drawn of a log of any length


class Stored:
    """A Parquet file as a :class:`stages.verdict.Table`, of which only what is asked for is read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = pq.ParquetFile(path)
        self.columns: list[str] = self.file.schema_arrow.names

    def select(self, columns: list[str], /) -> Stored:
        """The same rows of these columns."""
        other = copy(self)
        other.columns = columns
        return other

    @property
    def height(self) -> int:
        return int(self.file.metadata.num_rows)

    def __getitem__(self, column: str, /) -> pl.Series:
        return self._time if column == TIME else self._column(column)

    @cached_property
    def _time(self) -> pl.Series:
        return self._column(TIME)

    def _column(self, column: str) -> pl.Series:
        return frame_of(self.file.read([column]))[column]

    def slice(self, offset: int, length: int | None = None) -> pl.DataFrame:
        end = self.height if length is None else min(offset + length, self.height)
        counts = (self.file.metadata.row_group(i).num_rows for i in range(self.file.num_row_groups))
        ends = list(accumulate(counts))
        wanted = range(bisect_right(ends, offset), bisect_left(ends, end) + 1) if offset < end else range(0)
        before = ends[wanted[0] - 1] if wanted and wanted[0] else 0
        read = frame_of(self.file.read_row_groups(list(wanted), self.columns)).select(self.columns)
        return read.slice(offset - before, end - offset)


def thinned(path: Path, most: int | None = None) -> tuple[pl.DataFrame, NDArray[np.int64]]:
    """About ``most`` (else ``DRAWN``) of a file's rows, evenly taken, with those at which ``detection``
    changes, and their numbers; all of a short one."""
    file = pq.ParquetFile(path)
    every = max(1, -(-int(file.metadata.num_rows) // (most or DRAWN)))
    kept, numbers, before, last = [], [], 0, None
    for frame in _frames(file):
        rows = np.arange(before, before + frame.height)
        keep = rows % every == 0
        if DETECTION in frame.columns and frame.height:
            states = frame[DETECTION].to_numpy()
            keep |= np.append(last is not None and states[0] != last, states[1:] != states[:-1])
            last = states[-1]
        kept.append(frame.filter(pl.Series(keep)))
        numbers.append(rows[keep])
        before += frame.height
    if not kept:
        return pl.DataFrame(schema=pl.read_parquet_schema(path)), np.empty(0, np.int64)
    return pl.concat(kept), np.concatenate(numbers)


def evenly(path: Path, most: int | None = None) -> pl.DataFrame:
    """About ``most`` rows (:data:`DRAWN`) of a file, evenly taken; all of a short one."""
    file = pq.ParquetFile(path)
    step = max(1, file.metadata.num_rows // (most or DRAWN))
    kept, seen = [], 0
    for frame in _frames(file):
        kept.append(frame.gather_every(step, -seen % step))
        seen += frame.height
    return pl.concat(kept) if kept else frame_of(file.schema_arrow.empty_table())


def _frames(file: pq.ParquetFile) -> Iterator[pl.DataFrame]:
    """The row groups, one in memory at a time."""
    return (frame_of(file.read_row_group(i)) for i in range(file.num_row_groups))


class Reader:
    """Reads a Parquet file's rows in order of time, each once."""

    def __init__(self, path: Path) -> None:
        self.frames = _frames(pq.ParquetFile(path))
        self.rest = pl.DataFrame(schema=pl.read_parquet_schema(path))

    def before(self, time: float) -> pl.DataFrame:
        """The rows before ``time`` that have not been had."""
        while not self.rest.height or self.rest[TIME][-1] < time:
            if (frame := next(self.frames, None)) is None:
                break
            self.rest = pl.concat([self.rest, frame])
        count = int(self.rest[TIME].search_sorted(time, side="left"))
        had, self.rest = self.rest.head(count), self.rest.slice(count)
        return had


class Writer:
    """Writes frames of one schema into a Parquet file, which is there once something was added."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.writer: pq.ParquetWriter | None = None
        self.waiting: list[pl.DataFrame] = []

    def add(self, frame: pl.DataFrame) -> None:
        self.waiting.append(frame)
        if sum(f.estimated_size() for f in self.waiting) >= BYTES:
            self._flush()

    def _flush(self) -> None:
        if not self.waiting:
            return
        frame = pl.concat(self.waiting, how="vertical_relaxed")
        self.waiting = []
        table = frame.to_arrow(compat_level=pl.CompatLevel.oldest())
        if self.writer is None:
            # samples rarely repeat, so a dictionary of them costs time and space
            words = [f.name for f in table.schema if not pa.types.is_floating(f.type)]
            self.writer = pq.ParquetWriter(
                self.path, table.schema, compression="zstd", use_dictionary=words or False
            )
        self.writer.write_table(table.cast(self.writer.schema))

    def close(self) -> None:
        self._flush()
        if self.writer is not None:
            self.writer.close()


@contextmanager
def writing(path: Path) -> Iterator[Writer]:
    """A :class:`Writer`, closed in the end."""
    writer = Writer(path)
    try:
        yield writer
    finally:
        writer.close()
