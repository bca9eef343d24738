"""Rows of a table as protobuf messages in MCAP records, and back, a whole chunk at a time.

A message whose fields are all present and of fixed size has a fixed length on the wire, so a chunk of ``n``
rows is a matrix of ``n`` equal records: constant bytes (opcode, length, channel, field tags) from a template,
and at fixed offsets sequence, times and values. numpy sees it as a structured array, written and read column
by column. Missing numbers are NaN, so that no field is left out. Text follows the fixed part of its row (see
:mod:`ingest.mcap_text`). Only rows that lack a 64-bit integer go through the protobuf library.
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

from ingest.columns import column_of
from ingest.mcap_text import Texts, encode_text, interleave, take_apart, varint
from ingest.mcap_writer import Batch

CHUNK_BYTES = 1 << 20
_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FIXED = {  # numpy type and protobuf wire type
    "float": ("<f4", 5), "double": ("<f8", 1), "sfixed64": ("<i8", 1), "fixed64": ("<u8", 1),
}  # fmt: skip
_RAW = {
    "float": pl.Float32,
    "double": pl.Float64,
    "string": pl.String,
    "sfixed64": pl.Int64,
    "fixed64": pl.UInt64,
}
Column = NDArray[Any] | pl.Series
"""Numbers as an array, text as a series."""
_PROTO = {t: getattr(FieldDescriptorProto, f"TYPE_{t.upper()}") for t in _RAW}


def field_type(dtype: pl.DataType) -> str:
    """The protobuf type that holds a column exactly: a float or double wherever possible."""
    if dtype in (pl.Float32, pl.Int8, pl.Int16, pl.UInt8, pl.UInt16, pl.Boolean):
        return "float"
    return {pl.String: "string", pl.Int64: "sfixed64", pl.UInt64: "fixed64"}.get(dtype, "double")  # type: ignore[call-overload,no-any-return]


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

    @cached_property
    def texts(self) -> dict[str, bytes]:
        """Fields of text and their tags on the wire."""
        return {f: _tag(n, 2) for n, (f, t) in enumerate(self.fields.items(), 1) if t == "string"}

    @cached_property
    def record(self) -> tuple[np.dtype[np.void], NDArray[np.uint8], NDArray[np.uint8]]:
        """Fixed part of a record as numpy type, its bytes with 0 for what varies, and 255 for constants."""
        template, constant = bytearray(_HEAD.size), bytearray(_HEAD.size)
        places = {
            "length": ("<u8", 1),
            "sequence": ("<u4", 11),
            "log_time": ("<u8", 15),
            "publish_time": ("<u8", 23),
        }
        for number, (field, kind) in enumerate(self.fields.items(), 1):
            if kind in _FIXED:
                numpy_type, wire_type = _FIXED[kind]
                tag, size = _tag(number, wire_type), int(numpy_type[-1])
                places[f".{field}"] = (numpy_type, len(template) + len(tag))
                template += tag + bytes(size)
                constant += b"\xff" * len(tag) + bytes(size)
        _HEAD.pack_into(template, 0, Opcode.MESSAGE, len(template) - 9, self.channel_id, 0, 0, 0)
        constant[:1], constant[9:11] = b"\xff", b"\xff\xff"
        constant[1:9] = bytes(8) if self.texts else b"\xff" * 8
        formats, offsets = zip(*places.values(), strict=True)
        spec = {"names": list(places), "formats": formats, "offsets": offsets, "itemsize": len(template)}
        return np.dtype(spec), np.frombuffer(template, np.uint8), np.frombuffer(constant, np.uint8)  # type: ignore[call-overload]

    def encode(
        self, columns: Sequence[pl.Series], log_time: NDArray[np.uint64], first: int = 0
    ) -> Iterator[Batch]:
        """The rows as batches of about 1 MiB, numbered from ``first``; ``columns`` in order of the fields."""
        rows = max(1, CHUNK_BYTES // self.record[0].itemsize)
        raw = {f: c.cast(_RAW[t]) for c, (f, t) in zip(columns, self.fields.items(), strict=True)}
        arrays = {
            f: c.fill_null(float("nan") if c.dtype.is_float() else 0).to_numpy()
            for f, c in raw.items()
            if f not in self.texts
        }
        lacking = [c for f, c in raw.items() if not c.dtype.is_float() and f in arrays and c.null_count()]
        for start in range(0, len(log_time), rows):
            part = slice(start, start + rows)
            if any(c.slice(start, rows).null_count() for c in lacking):
                messages = self._messages({f: c.slice(start, rows) for f, c in raw.items()})
                yield from join(self.channel_id, messages, log_time[part], first + start)
                continue
            numbers = {f: a[part] for f, a in arrays.items()}
            texts = [encode_text(raw[f].slice(start, rows), tag) for f, tag in self.texts.items()]
            yield self._batch(numbers, texts, log_time[part], first + start)

    def _batch(
        self,
        numbers: Mapping[str, NDArray[Any]],
        texts: Sequence[Texts],
        log_time: NDArray[np.uint64],
        first: int,
    ) -> Batch:
        dtype, template, _ = self.record
        n = len(log_time)
        records = np.tile(template, n).view(dtype)
        records["sequence"] = np.arange(first, first + n)
        records["log_time"] = records["publish_time"] = log_time
        for field, values in numbers.items():
            records[f".{field}"] = values
        if not texts:
            offset = np.arange(n, dtype=np.uint64) * np.uint64(dtype.itemsize)
            return Batch(self.channel_id, records.tobytes(), log_time, offset)
        length = dtype.itemsize + np.stack([t.length for t in texts]).sum(axis=0)
        records["length"] = length - 9
        data, start = interleave(records.view(np.uint8).reshape(n, -1), length, texts)
        return Batch(self.channel_id, data, log_time, start)

    def _messages(self, columns: Mapping[str, pl.Series]) -> Iterator[bytes]:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(self.descriptor()).file:
            pool.Add(file)
        message = GetMessageClass(pool.FindMessageTypeByName(self.message))
        for values in zip(*columns.values(), strict=True):
            given = {f: v for f, v in zip(self.fields, values, strict=True) if v is not None}
            yield message(**given).SerializeToString()

    def decode(self, records: memoryview) -> dict[str, Column] | None:
        """Field -> values of a chunk's rows; None if a byte is not as this layout has it."""
        dtype, template, constant = self.record
        data = np.frombuffer(records, np.uint8)
        texts: dict[str, pl.Series] = {}
        if not self.texts:
            if len(data) % dtype.itemsize:
                return None
            matrix = data.reshape(-1, dtype.itemsize)
        else:
            parted = take_apart(records, dtype.itemsize, self.texts)
            if parted is None:
                return None
            matrix, texts = parted
        fixed = np.flatnonzero(constant)
        if (matrix[:, fixed] != template[fixed]).any():
            return None
        rows = matrix.reshape(-1).view(dtype)
        return {f: texts[f] if f in texts else rows[f".{f}"].copy() for f in self.fields}

    def rows(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Column]:
        """Decoded messages as columns of the fields; what a message leaves out is null."""
        return {f: pl.Series(f, [r.get(f) for r in rows], dtype=_RAW[t]) for f, t in self.fields.items()}

    def columns(self, parts: Sequence[Mapping[str, Column]]) -> dict[str, pl.Series]:
        """Parts end to end."""
        return {f: _end_to_end(f, [p[f] for p in parts], _RAW[t]) for f, t in self.fields.items()}


def _end_to_end(name: str, parts: Sequence[Column], dtype: Any) -> pl.Series:
    if parts and all(isinstance(p, np.ndarray) for p in parts):
        return column_of(name, np.concatenate(parts))
    series = [p if isinstance(p, pl.Series) else pl.Series(name, p) for p in parts]
    return pl.concat(series) if series else pl.Series(name, [], dtype=dtype)


def join(
    channel_id: int, messages: Iterable[bytes], log_time: NDArray[np.uint64], first: int = 0
) -> Iterator[Batch]:
    """Messages of any length as batches of about 1 MiB, in order, numbered from ``first``."""
    records, offsets, start = bytearray(), [], 0
    for i, (data, stamp) in enumerate(zip(messages, log_time.tolist(), strict=True)):
        offsets.append(len(records))
        records += _HEAD.pack(Opcode.MESSAGE, _HEAD.size - 9 + len(data), channel_id, first + i, stamp, stamp)
        records += data
        if len(records) >= CHUNK_BYTES or i + 1 == len(log_time):
            yield Batch(channel_id, bytes(records), log_time[start : i + 1], np.array(offsets, np.uint64))
            records, offsets, start = bytearray(), [], i + 1


def _tag(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)
