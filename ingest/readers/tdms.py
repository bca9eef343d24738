"""NI TDMS, by ``npTDMS``: one group per TDMS group and raster.

Time is a channel of that name in the group, or comes from the waveform properties ``wf_increment`` and
``wf_start_offset`` of the channels. The library reads a file that breaks off as far as it goes without a
word; what is missing is told.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ingest.clock import iso, time_column
from ingest.errors import LogError
from ingest.log import TIME, Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording, check_declared, need
from ingest.tables import Table, log_of_tables

_UNITS = ("unit_string", "NI_UnitDescription", "unit", "Unit", "units")
_DAMAGE = (ValueError, KeyError, IndexError, TypeError, OverflowError, MemoryError, EOFError, struct.error)


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins with a TDMS segment."""
    return head.startswith(b"TDSm")


def header(path: Path, names: NameMap) -> Recording:
    """Channels and lengths, without their samples."""
    return _read(path, names, rows=False)


def read(path: Path, names: NameMap) -> Recording:
    """All samples that are there.

    Raises:
        LogError: damaged, no group with a time, or no samples.
    """
    found = _read(path, names, rows=True)
    if not any(g.frame.height for g in found.log.groups.values()):
        raise LogError(f"{path}: no samples{': ' + '; '.join(found.log.facts.get('salvaged', ()))}")
    return found


def _read(path: Path, names: NameMap, *, rows: bool) -> Recording:
    with _opened(path) as file:
        tables: dict[str, Table] = {}
        counts: dict[str, int] = {}
        for name, channels in _rasters(path, file, names):
            tables[name] = _table(channels, names, rows)
            counts[name] = len(channels[0])
        if not tables:
            raise LogError(f"{path}: no samples: the file has no channel with values")
        log = log_of_tables(str(path), path.stem, tables, names.time)
        facts = {**_facts(file), **log.facts}
        if not rows:
            facts["rows"] = {k: counts[k] for k in log.groups}
        elif problem := _missing(file):
            facts["salvaged"] = [problem]
    return Recording(Log(log.name, log.groups, (), facts))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    nptdms = need("nptdms", "tdms")
    try:
        with nptdms.TdmsFile.open(path) as file:
            yield file
    except LogError:
        raise
    except _DAMAGE as error:
        raise LogError(f"{path}: damaged TDMS file: {error or type(error).__name__}") from error


def _rasters(path: Path, file: Any, names: NameMap) -> Iterator[tuple[str, list[Any]]]:
    """Channels that share their time stamps, by group; more rasters in a group are numbered."""
    for group in file.groups():
        rasters: dict[tuple[Any, ...], list[Any]] = defaultdict(list)
        for channel in group.channels():
            check_declared(path, len(channel), 1)
            wave = tuple(channel.properties.get(p) for p in ("wf_increment", "wf_start_offset"))
            if len(channel):
                rasters[(len(channel), *(wave if wave[0] else (None, None)))].append(channel)
        clock = time_column([c.name for c in group.channels()], names.time)
        for number, channels in enumerate(_with_clock(rasters, clock), 1):
            yield group.name if number == 1 else f"{group.name}_{number}", channels


def _with_clock(rasters: dict[tuple[Any, ...], list[Any]], clock: str | None) -> list[list[Any]]:
    """A time channel serves the channels of its own length, with or without waveform properties."""
    owner = next((k for k, channels in rasters.items() if any(c.name == clock for c in channels)), None)
    if owner is None:
        return list(rasters.values())
    merged = [c for key, channels in rasters.items() if key[0] == owner[0] for c in channels]
    return [merged, *(channels for key, channels in rasters.items() if key[0] != owner[0])]


def _table(channels: list[Any], names: NameMap, rows: bool) -> Table:
    columns: dict[str, pl.Series] = {}
    signals: dict[str, Signal] = {}
    for channel in channels:
        values = channel[:] if rows else channel[:1]
        columns[channel.name] = _series(values if rows else values[:0])
        unit = next((str(channel.properties[u]) for u in _UNITS if channel.properties.get(u)), None)
        about = str(channel.properties.get("description", ""))
        signals[channel.name] = Signal(name=channel.name, unit=unit, description=about)
    step = channels[0].properties.get("wf_increment")
    if time_column(columns, names.time) is None and step:
        start = float(channels[0].properties.get("wf_start_offset") or 0.0)
        length = len(next(iter(columns.values())))
        columns = {TIME: pl.Series(start + float(step) * np.arange(length)), **columns}
    return Table(pl.DataFrame(columns), signals)


def _series(values: Any) -> pl.Series:
    array = np.asarray(values)
    if array.dtype.kind == "O":
        return pl.Series([None if v is None else str(v) for v in array], dtype=pl.String)
    if array.dtype.kind == "M":
        return pl.Series(array.astype("datetime64[ns]"))
    return pl.Series(array.astype(array.dtype.newbyteorder("="), copy=False))


def _facts(file: Any) -> dict[str, Any]:
    starts = [c.properties.get("wf_start_time") for g in file.groups() for c in g.channels()]
    known = [s for s in starts if isinstance(s, np.datetime64)]
    return {"start_time": iso(int(min(known).astype("datetime64[ns]").astype(np.int64)))} if known else {}


def _missing(file: Any) -> str | None:
    """What a file that breaks off lacks."""
    status = file.file_status
    if not status.incomplete_final_segment:
        return None
    lost = [f"{p} {s.read_length} of {s.expected_length}" for p, s in (status.channel_statuses or {}).items()]
    some = ", ".join(lost[:3]) + (", …" if len(lost) > 3 else "")
    return f"the file breaks off in its last segment; values read of it: {some or 'none'}"
