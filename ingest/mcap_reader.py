"""Reads the container of an MCAP file, checking every checksum: what is damaged is left out and told.

With an intact summary each chunk is found by its index, so damage costs only the chunks it is in. Without one
(a recorder that was switched off) the records are walked from the start, up to where the file breaks off.
"""

from __future__ import annotations

import mmap
import struct
import threading
import zlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdDecompressor, ZstdError, frame_content_size

from ingest.threads import threads

_FOOTER = struct.Struct("<BQQQI")
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # times, unpacked size, its checksum, length of the name of the method
_LENGTH = struct.Struct("<Q")
_OWN = threading.local()
_AHEAD = 4  # chunks being unpacked
_LARGEST = 1 << 30  # bytes of an unpacked chunk
DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError, ZstdError)
"""What parsing and unpacking raise on bytes that are not what they should be."""


@dataclass
class McapFile:
    """The parts of a file. ``spans``: first and end byte of each chunk, and of messages outside chunks."""

    data: memoryview
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    spans: list[tuple[int, int]] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    statistics: Statistics | None = None
    problems: list[str] = field(default_factory=list)


def open_mcap(path: Path) -> McapFile:
    """Finds the parts of a file; unpacks no chunk.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        file = McapFile(memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)))
    try:
        indexes = _read_summary(file)
    except DAMAGE as error:
        indexes = []
        file.problems.append(f"the summary at the end is missing or damaged: {error}")
    if indexes:
        file.spans = sorted((i.chunk_start_offset, i.chunk_start_offset + i.chunk_length) for i in indexes)
    else:
        _walk(file)
    return file


def chunks(file: McapFile) -> Iterator[memoryview]:
    """The records of each chunk, unpacked and checked; damaged ones are left out and noted as problems."""
    with threads(2) as pool:  # unpacking runs outside the interpreter
        ahead: deque[tuple[int, Future[memoryview]]] = deque()
        spans = iter(file.spans)
        while True:
            for first, end in islice(spans, _AHEAD - len(ahead)):
                ahead.append((first, pool.submit(_unpack, file.data, first, end)))
            if not ahead:
                return
            at, unpacked = ahead.popleft()
            try:
                content = unpacked.result()
            except DAMAGE as error:
                file.problems.append(f"the chunk at byte {at} is damaged ({error}); its rows are lost")
            else:
                yield content


def records(data: memoryview, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, first and end byte of the content of each record.

    Raises:
        ValueError: a record reaches beyond ``end``.
    """
    while start < end:
        if start + _RECORD.size > end:
            raise ValueError(f"breaks off at byte {start}")
        opcode, length = _RECORD.unpack_from(data, start)
        start += _RECORD.size
        if opcode == 0 or start + length > end:
            raise ValueError(f"breaks off in the record at byte {start - _RECORD.size}")
        yield opcode, start, start + length
        start += length


def define(file: McapFile, opcode: int, content: memoryview) -> None:
    """Takes in a schema or channel record."""
    stream = ReadDataStream(BytesIO(content))
    if opcode == Opcode.SCHEMA:
        schema = Schema.read(stream)
        file.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(stream)
        file.channels[channel.id] = channel


def _read_summary(file: McapFile) -> list[ChunkIndex]:
    end = len(file.data) - len(MCAP0_MAGIC)
    if bytes(file.data[end:]) != MCAP0_MAGIC:
        raise ValueError("the file has no end mark")
    footer = end - _FOOTER.size
    opcode, length, start, offset_start, crc = _FOOTER.unpack(file.data[max(footer, 0) : end])
    if opcode != Opcode.FOOTER or length != _FOOTER.size - _RECORD.size or start > footer:
        raise ValueError("the footer is not one")
    if start and crc and zlib.crc32(file.data[start : end - 4]) != crc:
        raise ValueError("wrong checksum")
    indexes = []
    for opcode, first, last in records(file.data, start or footer, offset_start or footer):
        content = file.data[first:last]
        define(file, opcode, content)
        if opcode == Opcode.CHUNK_INDEX:
            indexes.append(ChunkIndex.read(ReadDataStream(BytesIO(content))))
        elif opcode == Opcode.METADATA_INDEX:
            _take_metadata(file, MetadataIndex.read(ReadDataStream(BytesIO(content))).offset)
        elif opcode == Opcode.STATISTICS:
            file.statistics = Statistics.read(ReadDataStream(BytesIO(content)))
    return indexes


def _walk(file: McapFile) -> None:
    """Spans and metadata without an index."""
    try:
        for opcode, first, end in records(file.data, len(MCAP0_MAGIC), len(file.data)):
            start = first - _RECORD.size
            if opcode == Opcode.CHUNK:
                file.spans.append((start, end))
            elif opcode == Opcode.METADATA:
                _take_metadata(file, start)
            elif opcode == Opcode.DATA_END:
                return
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                follows = (
                    file.spans and file.spans[-1][1] == start and file.data[file.spans[-1][0]] != Opcode.CHUNK
                )
                file.spans.append((file.spans.pop()[0] if follows else start, end))
        file.problems.append("the file breaks off before its end")
    except ValueError as error:
        file.problems.append(f"the file {error}; what follows is lost")


def _take_metadata(file: McapFile, start: int) -> None:
    try:
        opcode, first, end = next(records(file.data, start, len(file.data)))
        if opcode != Opcode.METADATA:
            raise ValueError(f"opcode {opcode}")
        file.metadata.append(Metadata.read(ReadDataStream(BytesIO(file.data[first:end]))))
    except DAMAGE as error:
        file.problems.append(f"the metadata at byte {start} are damaged: {error}")


def _unpack(data: memoryview, first: int, end: int) -> memoryview:
    if data[first] != Opcode.CHUNK:
        return data[first:end]
    chunk = _chunk(data[first + _RECORD.size : end])
    if chunk.uncompressed_size > _LARGEST:
        raise ValueError(f"unpacked {chunk.uncompressed_size} bytes, more than any writer makes")
    if chunk.compression != "zstd":
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        content = memoryview(stream.read(size))
    elif frame_content_size(chunk.data) > chunk.uncompressed_size:
        raise ValueError("its content is larger than it says")
    else:
        content = memoryview(_unzstd(chunk.data, chunk.uncompressed_size))
        if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
            raise ValueError("wrong checksum")
    if len(content) != chunk.uncompressed_size:
        raise ValueError(f"{len(content)} bytes instead of {chunk.uncompressed_size}")
    return content


def _chunk(content: memoryview) -> Chunk:
    """A chunk record whose data stay where they are: the library copies them twice."""
    start, end, size, crc, words = _CHUNK.unpack_from(content)
    at = _CHUNK.size + words
    (length,) = _LENGTH.unpack_from(content, at)
    data: Any = content[at + _LENGTH.size :][:length]
    return Chunk(
        message_start_time=start,
        message_end_time=end,
        uncompressed_size=size,
        uncompressed_crc=crc,
        compression=str(content[_CHUNK.size : at], "utf-8"),
        data=data,
    )


def _unzstd(data: bytes, size: int) -> bytes:
    """Decompressed by a decompressor that each thread makes once."""
    if not hasattr(_OWN, "zstd"):
        _OWN.zstd = ZstdDecompressor()
    return bytes(_OWN.zstd.decompress(data, max_output_size=size))
