"""Writes MCAP files chunk by chunk, from message bytes that were laid out as whole arrays.

The library's own writer takes one message per call, which costs more than everything else together; its
record classes are used for all that is written once per chunk or file. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import IO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from ingest.threads import threads

_MEDIA_TYPES = {"json": "application/json", "toml": "application/toml"}


@dataclass(frozen=True)
class Batch:
    """Messages of one channel: their records end to end, and of each its log time in ns and its offset."""

    channel_id: int
    records: bytes
    log_time: NDArray[np.uint64]
    offset: NDArray[np.uint64]


@dataclass
class McapWriter:
    """One file: ``add_metadata``, ``add`` batches, then ``finish``.

    Schemas and channels stand in the first chunk and again in the summary, as other writers do it.
    """

    stream: IO[bytes]
    schemas: Sequence[Schema]
    channels: Sequence[Channel]
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.first = _bytes(*self.schemas, *self.channels)
        self.stream.write(MCAP0_MAGIC)
        self.stream.write(_bytes(Header(profile="", library="dynoscope")))

    def add_metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        record = _bytes(Metadata(name=name, metadata=dict(pairs)))
        self.metadata.append(MetadataIndex(offset=self.stream.tell(), length=len(record), name=name))
        self.stream.write(record)

    def add_attachment(self, name: str, content: bytes) -> None:
        kind = _MEDIA_TYPES.get(name.rpartition(".")[2], "application/octet-stream")
        start = self.stream.tell()
        record = _bytes(Attachment(create_time=0, log_time=0, name=name, media_type=kind, data=content))
        self.stream.write(record)
        self.attachments.append(
            AttachmentIndex(
                offset=start,
                length=len(record),
                create_time=0,
                log_time=0,
                data_size=len(content),
                name=name,
                media_type=kind,
            )
        )

    def add(self, batches: Iterable[Batch]) -> None:
        """Writes each batch as one chunk with its message index; two are packed at a time."""
        pending: deque[tuple[Batch, int, Future[Chunk]]] = deque()
        with threads(2) as pool:  # packing is most of the work, and runs outside the interpreter
            for batch in batches:
                pending.append((batch, len(self.first), pool.submit(_pack, batch, self.first)))
                self.first = b""
                if len(pending) > 2:
                    self._write(*_done(pending))
            while pending:
                self._write(*_done(pending))

    def _write(self, batch: Batch, shift: int, chunk: Chunk) -> None:
        start = self.stream.tell()
        self.stream.write(_bytes(chunk))
        index_start = self.stream.tell()
        entries = np.column_stack([batch.log_time, batch.offset + np.uint64(shift)]).astype("<u8").tobytes()
        head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), batch.channel_id, len(entries))
        self.stream.write(head + entries)
        self.counts[batch.channel_id] = self.counts.get(batch.channel_id, 0) + len(batch.log_time)
        self.chunks.append(
            ChunkIndex(
                chunk_length=index_start - start,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(head) + len(entries),
                message_index_offsets={batch.channel_id: index_start},
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def finish(self) -> None:
        """Writes summary and footer; the stream stays open."""
        self.stream.write(_bytes(DataEnd(data_section_crc=0)))
        start = self.stream.tell()
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, self.schemas),
            (Opcode.CHANNEL, self.channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.ATTACHMENT_INDEX, self.attachments),
            (Opcode.METADATA_INDEX, self.metadata),
        ]
        summary, offsets = b"", b""
        for opcode, records in groups:
            part = _bytes(*records)
            offsets += _bytes(SummaryOffset(opcode, start + len(summary), len(part))) if part else b""
            summary += part
        offset_start = start + len(summary)
        crc = zlib.crc32(summary + offsets + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start))
        self.stream.write(summary + offsets + _bytes(Footer(start, offset_start, crc)) + MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_end_time=max((c.message_end_time for c in self.chunks), default=0),
            message_start_time=min((c.message_start_time for c in self.chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


def _pack(batch: Batch, first: bytes) -> Chunk:
    records = first + batch.records
    return Chunk(
        compression="zstd",
        data=zstandard.compress(records, level=1),  # half the time of level 3 for a tenth more bytes
        message_start_time=int(batch.log_time.min()),
        message_end_time=int(batch.log_time.max()),
        uncompressed_crc=zlib.crc32(records),
        uncompressed_size=len(records),
    )


def _done(pending: deque[tuple[Batch, int, Future[Chunk]]]) -> tuple[Batch, int, Chunk]:
    batch, shift, packed = pending.popleft()
    return batch, shift, packed.result()


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
