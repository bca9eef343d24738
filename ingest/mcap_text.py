"""Text fields of protobuf rows, a whole chunk at a time: they follow the fixed part of their row.

On the wire a text is its tag, its length as a varint and its bytes; a missing one is left out. Signals of
words are states, so few texts differ, and each is laid out once for all its rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

_HEAD_BYTES = 9  # opcode and length of a record
_LONG = 128  # from here on a length takes two bytes


class Texts(NamedTuple):
    """A text column as bytes of the wire: each different one, which one a row has, and its length there."""

    words: list[bytes]
    which: NDArray[np.int64]
    length: NDArray[np.int64]


def varint(value: int) -> bytes:
    """Protobuf's variable-length integer.

    >>> varint(300)
    b'\\xac\\x02'
    """
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def encode_text(column: pl.Series, tag: bytes) -> Texts:
    """A column of text for fields with ``tag``."""
    different = column.drop_nulls().unique(maintain_order=True)
    raw = [w.encode() for w in different.to_list()]
    words = [b"", *(tag + varint(len(w)) + w for w in raw)]
    number = pl.Series(range(1, len(words)), dtype=pl.Int64)
    which = column.replace_strict(different, number, default=0, return_dtype=pl.Int64).fill_null(0).to_numpy()
    return Texts(words, which, np.array([len(w) for w in words])[which])


def interleave(
    fixed: NDArray[np.uint8], length: NDArray[np.int64], texts: Sequence[Texts]
) -> tuple[bytes, NDArray[np.uint64]]:
    """Rows of ``length`` bytes end to end, each its fixed part and its texts; and where each begins."""
    ends = np.cumsum(length)
    start = ends - length
    data = np.empty(int(ends[-1]), np.uint8)
    data[start[:, None] + np.arange(fixed.shape[1])] = fixed
    at = start + fixed.shape[1]
    for column in texts:
        for number, word in enumerate(column.words):
            rows = at[column.which == number] if word else at[:0]
            data[rows[:, None] + np.arange(len(word))] = np.frombuffer(word, np.uint8)
        at = at + column.length
    return data.tobytes(), start.astype(np.uint64)


def take_apart(
    records: memoryview, size: int, tags: Mapping[str, bytes]
) -> tuple[NDArray[np.uint8], dict[str, pl.Series]] | None:
    """The fixed parts of ``size`` bytes and the texts by field; None if the records are not so laid out."""
    starts, at = [], 0
    while at + _HEAD_BYTES < len(records):
        starts.append(at)
        at += _HEAD_BYTES + int.from_bytes(records[at + 1 : at + _HEAD_BYTES], "little")
    start = np.array(starts)
    end = np.append(start[1:], at)
    if at != len(records) or (end - start < size).any():
        return None
    data = np.frombuffer(records, np.uint8)
    padded = np.append(data, np.zeros(4, np.uint8))
    place, texts = start + size, {}
    for field, tag in tags.items():
        present = place < end
        for i, byte in enumerate(tag):
            present &= padded[np.minimum(place + i, len(data))] == byte
        first = np.minimum(place + len(tag), len(data))
        low, high = padded[first].astype(np.int64), padded[first + 1].astype(np.int64)
        long = low >= _LONG
        if (present & long & (high >= _LONG)).any():
            return None  # longer than 16 KiB
        count = np.where(long, (low & 127) | high << 7, low)
        begin = first + 1 + long
        place = np.where(present, begin + count, place)
        if (place > end).any():
            return None
        spans = zip(present.tolist(), begin.tolist(), place.tolist(), strict=True)
        texts[field] = pl.Series(
            field, [str(records[a:b], "utf-8") if p else None for p, a, b in spans], pl.String
        )
    return (data[start[:, None] + np.arange(size)], texts) if (place == end).all() else None
