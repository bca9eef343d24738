"""The header of a plain MDF 4 file, from its blocks: asammdf needs more than a second before it reads any.

Only what is common is read here: sorted or unsorted channel groups of numbers and texts, without conversion,
with a linear one or one to text. Of any other file :func:`plain_header` knows nothing, and of a damaged one.
Blocks are those of the ASAM MDF standard, version 4: ``##XX``, length, number of links, links, data.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import polars as pl

from ingest.about import parse_about
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.mdf_samples import group_name, signal_of, unique_name
from ingest.readers import Recording, check_declared
from ingest.tables import distinct

ABOUT = "dynoscope.json"
_HD = 64  # where the header block lies
_LINKS = {b"HD": 6, b"DG": 4, b"CG": 6, b"CN": 8, b"CC": 4, b"AT": 4}  # as many at least
_VALUE, _VLSD, _MASTER = 0, 1, 2  # channel types
_TIME = 1  # sync type
_INTEGERS = {
    8: (pl.UInt8, pl.Int8),
    16: (pl.UInt16, pl.Int16),
    32: (pl.UInt32, pl.Int32),
    64: (pl.UInt64, pl.Int64),
}
_FLOATS = {16: pl.Float32, 32: pl.Float32, 64: pl.Float64}
_LINEAR, _TO_TEXT = 1, (7, 8)  # conversions
_LOCAL_TIME = 1  # flag of the header
_EMBEDDED, _COMPRESSED = 1, 2  # flags of an attachment


@dataclass(frozen=True, kw_only=True)
class PlainChannel:
    """A channel as a column."""

    name: str
    unit: str
    comment: str
    dtype: pl.DataType
    is_master: bool


@dataclass(frozen=True, kw_only=True)
class PlainGroup:
    """A channel group of ``rows`` records."""

    name: str
    comment: str
    rows: int
    channels: tuple[PlainChannel, ...]


@dataclass(frozen=True, kw_only=True)
class PlainHeader:
    """What the file holds; ``attachments`` by file name."""

    start: datetime
    groups: tuple[PlainGroup, ...]
    attachments: dict[str, bytes]


class _UnusualError(Exception):
    """Not for this reader."""


def plain_header(path: Path) -> PlainHeader | None:
    """The header of an MDF 4 file; None if it holds anything else than the above, or is damaged."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return _Blocks(content).header()
    except (_UnusualError, struct.error, zlib.error, OverflowError, ValueError):
        return None


def plain_recording(path: Path) -> Recording | None:
    """The log without its rows, as asammdf would give it; None where asammdf must look."""
    header = plain_header(path)
    if header is None:
        return None
    text = next((c for n, c in header.attachments.items() if Path(n).name == ABOUT), None)
    about = parse_about(f"{path}, attachment {ABOUT}", text) if text is not None else {}
    groups: dict[str, Group] = {}
    for i, group in enumerate(header.groups):
        name = group_name(i, group.name, group.comment, groups)
        check_declared(path, group.rows, len(group.channels))
        if sum(c.is_master for c in group.channels) != 1:
            return None
        columns: dict[str, pl.DataType] = {TIME: pl.Float64()}
        signals: dict[str, Signal] = {}
        for c in (c for c in group.channels if not c.is_master):
            unique = unique_name(c.name, columns)
            columns[unique] = c.dtype
            known = about.get("signals", {}).get(unique)
            signals[unique] = (
                Signal.from_metadata(unique, known) if known
                else signal_of(unique, c.name, c.unit, c.comment, c.dtype)
            )  # fmt: skip
        groups[name] = Group(name, pl.DataFrame(schema=columns), signals)
    if not groups:
        return None
    start = {} if about or header.start.year <= 1970 else {"start_time": header.start.isoformat()}
    rows = {"rows": {n: g.rows for n, g in zip(groups, header.groups, strict=True)}}
    events = tuple(Event(**e) for e in about.get("events", ()))
    facts = {**about.get("facts", {}), **start, **rows}
    return Recording(Log(about.get("name", path.stem), distinct(groups), events, facts), ours=bool(about))


class _Blocks:
    """The blocks of a mapped file."""

    def __init__(self, content: mmap.mmap) -> None:
        self.content = content

    def header(self) -> PlainHeader:
        (version,) = struct.unpack_from("<H", self.content, 28)
        if self.content[:8] != b"MDF     " or not 400 <= version < 500:
            raise _UnusualError
        links, data = self._block(_HD, b"HD")
        groups = [g for at in self._chain(links[0], b"DG") for g in self._data_group(at)]
        attachments = dict(self._attachment(at) for at in self._chain(links[3], b"AT"))
        return PlainHeader(start=_start(data), groups=tuple(groups), attachments=attachments)

    def _block(self, at: int, kind: bytes) -> tuple[Sequence[int], bytes]:
        """Links and data."""
        mark, length, count = struct.unpack_from("<2x2s4xQQ", self.content, at)
        if mark != kind or count < _LINKS.get(kind, 0) or at + length > len(self.content):
            raise _UnusualError
        body = at + 24 + 8 * count
        return struct.unpack_from(f"<{count}Q", self.content, at + 24), self.content[body : at + length]

    def _chain(self, at: int, kind: bytes) -> Iterator[int]:
        """The blocks of a list, whose first link is the next one."""
        seen: set[int] = set()
        while at:
            if at in seen:
                raise _UnusualError
            seen.add(at)
            yield at
            at = self._block(at, kind)[0][0]

    def _text(self, at: int) -> str:
        """Of a TX or MD block, "" of none."""
        if not at:
            return ""
        mark, length = struct.unpack_from("<2x2s4xQ", self.content, at)
        if mark not in (b"TX", b"MD") or at + length > len(self.content):
            raise _UnusualError
        return self.content[at + 24 : at + length].split(b"\0", 1)[0].strip(b" \r\t\n").decode()

    def _data_group(self, at: int) -> Iterator[PlainGroup]:
        links, _ = self._block(at, b"DG")
        self._check_data(links[2])
        for group in self._chain(links[1], b"CG"):
            (_, first, name, _, _, comment, *_), data = self._block(group, b"CG")
            rows, flags = struct.unpack_from("<QH", data, 8)
            if flags:  # variable lengths, bus events, a master elsewhere
                raise _UnusualError
            channels = tuple(self._channel(c) for c in self._chain(first, b"CN"))
            yield PlainGroup(name=self._text(name), comment=self._text(comment), rows=rows, channels=channels)

    def _channel(self, at: int) -> PlainChannel:
        (_, composition, name, _, conversion, _, unit, comment, *_), data = self._block(at, b"CN")
        kind, sync, data_type, bit_offset, _, bits = struct.unpack_from("<BBBBII", data)
        if (
            composition
            or kind not in (_VALUE, _VLSD, _MASTER)
            or bit_offset
            or (kind == _MASTER and sync != _TIME)
        ):
            raise _UnusualError
        dtype = _dtype(data_type, bits)
        if (kind == _VLSD) != (dtype == pl.String and kind != _VALUE):
            raise _UnusualError
        return PlainChannel(
            name=self._text(name), unit=self._text(unit), comment=self._text(comment),
            dtype=self._converted(dtype, conversion), is_master=kind == _MASTER,
        )  # fmt: skip

    def _converted(self, dtype: pl.DataType, at: int) -> pl.DataType:
        """The type behind a conversion."""
        if not at:
            return dtype
        links, data = self._block(at, b"CC")
        kind, _, _, _, count = struct.unpack_from("<BBHHH", data)
        if kind in _TO_TEXT and dtype.is_integer():
            for text in links[4:]:
                self._text(text)  # a further conversion is none
            return pl.String()
        if kind == 0 or (kind == _LINEAR and struct.unpack_from("<2d", data, 24) == (0.0, 1.0)):
            return dtype
        if kind == _LINEAR and count == 2 and dtype.is_numeric():
            return pl.Float64() if dtype.is_integer() else dtype
        raise _UnusualError

    def _check_data(self, at: int) -> None:
        """All data lie inside the file."""
        mark = self.content[at + 2 : at + 4] if at else b""
        if mark == b"HL":
            return self._check_data(self._block(at, b"HL")[0][0])
        lists = self._chain(at, b"DL") if mark == b"DL" else ()
        for block in (
            [b for part in lists for b in self._block(part, b"DL")[0][1:]] if mark == b"DL" else [at]
        ):
            if not block:
                continue
            mark, length = struct.unpack_from("<2x2s4xQ", self.content, block)
            if mark not in (b"DT", b"DZ") or block + length > len(self.content):
                raise _UnusualError
        return None

    def _attachment(self, at: int) -> tuple[str, bytes]:
        links, data = self._block(at, b"AT")
        (flags,) = struct.unpack_from("<H", data)
        (size,) = struct.unpack_from("<Q", data, 32)
        content = data[40 : 40 + size] if flags & _EMBEDDED else b""
        return self._text(links[1]), zlib.decompress(content) if flags & _COMPRESSED else content


def _dtype(data_type: int, bits: int) -> pl.DataType:
    """Of raw values: unsigned, signed, real, each of both byte orders; text."""
    if data_type in (0, 1, 2, 3) and bits in _INTEGERS:
        return _INTEGERS[bits][data_type // 2]()
    if data_type in (4, 5) and bits in _FLOATS:
        return _FLOATS[bits]()
    if data_type in (6, 7):
        return pl.String()
    raise _UnusualError


def _start(data: bytes) -> datetime:
    ns, offset, summer, flags = struct.unpack_from("<Qhhb", data)
    if flags & _LOCAL_TIME:
        return datetime.fromtimestamp(ns / 1e9, UTC).replace(tzinfo=None)
    return datetime.fromtimestamp(ns / 1e9, timezone(timedelta(minutes=offset + summer)))
