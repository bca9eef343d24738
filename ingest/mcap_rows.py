"""Rows of a table as protobuf messages in MCAP records, and back, a whole chunk at a time.

A message whose fields are all present and of fixed size has a fixed length on the wire, so a chunk of ``n``
rows is a matrix of ``n`` equal records: constant bytes (opcode, length, channel, field tags) from a template,
and at fixed offsets sequence, times and values. numpy sees it as a structured array, written and read column
by column. Missing numbers are NaN, so that no field is ever left out. Rows with text, or with integers that
no double holds, have no fixed length; they go through the protobuf library.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import polars as pl
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ingest.mcap_writer import Batch

CHUNK_BYTES = 1 << 20
_EXACT = 1 << 53  # integers up to here are doubles
_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CONSTANT = 11  # bytes of the head that are the same in every record of a channel
_FIXED = {"float": ("<f4", 5), "double": ("<f8", 1)}  # numpy type and protobuf wire type
_RAW = {
    "float": pl.Float32,
    "double": pl.Float64,
    "string": pl.String,
    "int64": pl.Int64,
    "uint64": pl.UInt64,
}
_PROTO = {t: getattr(FieldDescriptorProto, f"TYPE_{t.upper()}") for t in _RAW}


def field_type(values: pl.Series) -> str:
    """The protobuf type that holds a column exactly: a float or double wherever possible."""
    if values.dtype == pl.String:
        return "string"
    if values.dtype in (pl.Float32, pl.Int8, pl.Int16, pl.UInt8, pl.UInt16, pl.Boolean):
        return "float"
    ends = [e for e in (values.min(), values.max()) if isinstance(e, int)]
    if any(abs(e) > _EXACT for e in ends):
        return "int64" if values.dtype == pl.Int64 else "uint64"
    return "double"


def field_names(columns: Iterable[str]) -> list[str]:
    """Protobuf identifiers, one per column, that differ in more than case and underscores.

    >>> field_names(["p_Bst", "truth.p_Bst", "pBst", "2nd"])
    ['p_Bst', 'truth_p_Bst', 'pBst_2', '_2nd']
    """
    names: list[str] = []
    taken: set[str] = set()
    for column in columns:
        stem = name = re.sub(r"^(?=\d)|^$", "_", re.sub(r"[^A-Za-z0-9_]", "_", column))
        n = 1
        while (key := name.replace("_", "").casefold()) in taken:
            n += 1
            name = f"{stem}_{n}"
        taken.add(key)
        names.append(name)
    return names


@dataclass(frozen=True)
class Layout:
    """How the rows of one channel stand in the file.

    ``fields``: protobuf field -> type, in order of the field numbers from 1; each is ``optional``.
    """

    channel_id: int
    message: str
    fields: Mapping[str, str]

    @classmethod
    def from_descriptor(cls, channel_id: int, message: str, data: bytes) -> Layout:
        """The layout that :meth:`descriptor` described."""
        (proto,) = FileDescriptorSet.FromString(data).file[0].message_type
        types = {number: name for name, number in _PROTO.items()}
        return cls(channel_id, message, {f.name: types[f.type] for f in proto.field})

    def descriptor(self) -> bytes:
        """A serialized ``FileDescriptorSet``, MCAP's schema for protobuf."""
        files = FileDescriptorSet()
        package, _, name = self.message.rpartition(".")
        message = files.file.add(name=f"{self.message}.proto", package=package).message_type.add(name=name)
        for number, (field, kind) in enumerate(self.fields.items(), 1):
            label = FieldDescriptorProto.LABEL_OPTIONAL
            message.field.add(name=field, number=number, type=_PROTO[kind], label=label)
        return bytes(files.SerializeToString())

    @property
    def fixed(self) -> bool:
        """Whether every row has the same length."""
        return all(t in _FIXED for t in self.fields.values())

    @cached_property
    def record(self) -> tuple[np.dtype[np.void], NDArray[np.uint8], NDArray[np.uint8]]:
        """Record as numpy type, its bytes with zeros for what varies, and 255 where a byte is constant."""
        template, constant = bytearray(_HEAD.size), bytearray(b"\xff" * _CONSTANT)
        constant += bytes(_HEAD.size - _CONSTANT)
        places = {"sequence": ("<u4", 11), "log_time": ("<u8", 15), "publish_time": ("<u8", 23)}
        for number, (field, kind) in enumerate(self.fields.items(), 1):
            numpy_type, wire_type = _FIXED[kind]
            tag, size = _varint(number << 3 | wire_type), int(numpy_type[-1])
            places[f".{field}"] = (numpy_type, len(template) + len(tag))
            template += tag + bytes(size)
            constant += b"\xff" * len(tag) + bytes(size)
        _HEAD.pack_into(template, 0, Opcode.MESSAGE, len(template) - 9, self.channel_id, 0, 0, 0)
        formats, offsets = zip(*places.values(), strict=True)
        spec = {"names": list(places), "formats": formats, "offsets": offsets, "itemsize": len(template)}
        return np.dtype(spec), np.frombuffer(template, np.uint8), np.frombuffer(constant, np.uint8)  # type: ignore[call-overload]

    def encode(self, columns: Sequence[pl.Series], log_time: NDArray[np.uint64]) -> Iterator[Batch]:
        """The rows as batches of about 1 MiB, in order; ``columns`` in order of the fields."""
        return self._encode_fixed(columns, log_time) if self.fixed else self._encode_rows(columns, log_time)

    def _encode_fixed(self, columns: Sequence[pl.Series], log_time: NDArray[np.uint64]) -> Iterator[Batch]:
        dtype, template, _ = self.record
        raw = [_RAW[t] for t in self.fields.values()]
        arrays = [c.cast(t).fill_null(float("nan")).to_numpy() for c, t in zip(columns, raw, strict=True)]
        rows = max(1, CHUNK_BYTES // dtype.itemsize)
        for start in range(0, len(log_time), rows):
            part = slice(start, start + rows)
            n = len(log_time[part])
            records = np.tile(template, n).view(dtype)
            records["sequence"] = np.arange(start, start + n)
            records["log_time"] = records["publish_time"] = log_time[part]
            for field, values in zip(self.fields, arrays, strict=True):
                records[f".{field}"] = values[part]
            offset = np.arange(n, dtype=np.uint64) * np.uint64(dtype.itemsize)
            yield Batch(self.channel_id, records.tobytes(), log_time[part], offset)

    def _encode_rows(self, columns: Sequence[pl.Series], log_time: NDArray[np.uint64]) -> Iterator[Batch]:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(self.descriptor()).file:
            pool.Add(file)
        message = GetMessageClass(pool.FindMessageTypeByName(self.message))
        raw = [c.cast(_RAW[t]) for c, t in zip(columns, self.fields.values(), strict=True)]
        rows = (
            message(**{f: v for f, v in zip(self.fields, values, strict=True) if v is not None})
            for values in zip(*raw, strict=True)
        )
        yield from join(self.channel_id, (r.SerializeToString() for r in rows), log_time)

    def decode(self, records: memoryview) -> dict[str, NDArray[Any]] | None:
        """Field -> values of a chunk's rows; None if a byte is not as this layout has it."""
        if not self.fixed:
            return None
        dtype, template, constant = self.record
        if len(records) % dtype.itemsize:
            return None
        matrix = np.frombuffer(records, np.uint8).reshape(-1, dtype.itemsize)
        if ((matrix ^ template) & constant).any():
            return None
        rows = np.frombuffer(records, dtype)
        return {field: np.ascontiguousarray(rows[f".{field}"]) for field in self.fields}

    def frame(self, rows: Sequence[Mapping[str, Any]]) -> pl.DataFrame:
        """Decoded messages as a table of the fields; what a message leaves out is null."""
        return pl.DataFrame(
            [pl.Series(f, [r.get(f) for r in rows], dtype=_RAW[t]) for f, t in self.fields.items()]
        )


def join(channel_id: int, messages: Iterable[bytes], log_time: NDArray[np.uint64]) -> Iterator[Batch]:
    """Messages of any length as batches of about 1 MiB, in order."""
    records, offsets, start = bytearray(), [], 0
    for i, (data, stamp) in enumerate(zip(messages, log_time.tolist(), strict=True)):
        offsets.append(len(records))
        records += _HEAD.pack(Opcode.MESSAGE, _HEAD.size - 9 + len(data), channel_id, i, stamp, stamp) + data
        if len(records) >= CHUNK_BYTES or i + 1 == len(log_time):
            yield Batch(channel_id, bytes(records), log_time[start : i + 1], np.array(offsets, np.uint64))
            records, offsets, start = bytearray(), [], i + 1


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
