"""Arrow IPC: files (also Feather) and streams. Of one that breaks off, the whole record batches are kept."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa

from ingest.errors import LogError
from ingest.log import Log
from ingest.maps import NameMap
from ingest.readers import Recording, check_declared
from ingest.readers.parquet import GROUP, frame_of, signals_of
from ingest.tables import Table, log_of_tables

_MAGIC = b"ARROW1"
_STREAM = b"\xff\xff\xff\xff"  # marks the schema message a stream begins with


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins as an Arrow file or stream."""
    return head.startswith((_MAGIC, _STREAM))


def header(path: Path, names: NameMap) -> Recording:
    """Channels from the schema."""
    schema = _read(path, rows=False)[0].schema
    empty = Table(frame_of(schema.empty_table()), signals_of(schema))
    return Recording(log_of_tables(str(path), path.stem, {GROUP: empty}, names.time))


def read(path: Path, names: NameMap) -> Recording:
    """All whole record batches; what is missing is told in the fact ``salvaged``.

    Raises:
        LogError: damaged, without a time column, or without samples.
    """
    table, problem = _read(path, rows=True)
    log = log_of_tables(
        str(path), path.stem, {GROUP: Table(frame_of(table), signals_of(table.schema))}, names.time
    )
    if not log.groups[GROUP].frame.height:
        raise LogError(f"{path}: no samples{f': {problem}' if problem else ''}")
    facts = {**log.facts, **({"salvaged": [problem]} if problem else {})}
    return Recording(Log(log.name, log.groups, (), facts))


def _read(path: Path, *, rows: bool) -> tuple[pa.Table, str | None]:
    """The table, and what kept it from being whole."""
    batches: list[pa.RecordBatch] = []
    problem = None
    try:
        with pa.memory_map(str(path)) as file:
            if file.read(len(_MAGIC)) == _MAGIC:
                try:
                    whole = pa.ipc.open_file(file)
                    every = [whole.get_batch(i) for i in range(whole.num_record_batches if rows else 0)]
                    return pa.Table.from_batches(_checked(path, every), whole.schema), None
                except pa.ArrowException:  # the footer is gone: the batches stand before it as a stream
                    file.seek(8)
                    problem = "the footer is missing: batches behind a damaged one are lost"
            else:
                file.seek(0)
            stream = pa.ipc.open_stream(file)
            try:
                while rows:
                    batches.append(stream.read_next_batch())
            except StopIteration:
                pass
            except (pa.ArrowException, OSError) as error:
                problem = f"the file breaks off after {sum(b.num_rows for b in batches)} rows: {error}"
            return pa.Table.from_batches(_checked(path, batches), stream.schema), problem
    except (pa.ArrowException, OSError) as error:
        raise LogError(f"{path}: damaged Arrow file: {str(error).splitlines()[0]}") from error


def _checked(path: Path, batches: list[pa.RecordBatch]) -> list[pa.RecordBatch]:
    """Offsets and lengths of the columns are within the file; the format has no checksums."""
    for batch in batches:
        check_declared(path, batch.num_rows, batch.num_columns)
        batch.validate(full=True)
    return batches
