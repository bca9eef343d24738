"""MDF channels as columns and signals, names of groups, and the blocks of a file in which samples lie."""

from __future__ import annotations

from collections.abc import Container, Iterator
from copy import copy
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.columns import column_of
from ingest.log import Signal

_PIECE = 1 << 23  # bytes


def cut_blocks(group: Any) -> None:
    """Makes pieces of the large plain data blocks of an ``asammdf`` group.

    The library reads a block whole for each range of records, and many writers make one block of everything.
    """
    record = group.channel_group.samples_byte_nr + getattr(group.channel_group, "invalidation_bytes_nr", 0)
    size = max(1, _PIECE // max(record, 1)) * record
    group.data_blocks = [piece for block in group.data_blocks or () for piece in _pieces(block, size)]


def _pieces(block: Any, size: int) -> Iterator[Any]:
    plain = not block.block_type and block.block_limit is None and block.invalidation_block is None
    if not plain or size <= 0 or block.original_size <= size:
        yield block
        return
    for start in range(0, block.original_size, size):
        piece = copy(block)
        piece.address = block.address + start
        piece.original_size = piece.compressed_size = min(size, block.original_size - start)
        yield piece


def group_name(number: int, name: str, comment: str, taken: Container[str]) -> str:
    """The name of channel group ``number``: its own, the first line of its comment, or numbered."""
    line = (comment or "").strip().splitlines()[:1]
    name = name or (line[0] if line and "<" not in line[0] else "") or f"group_{number + 1}"
    return name if name not in taken else f"{name}_{number + 1}"


def signal_of(name: str, source: str, unit: str, comment: str, dtype: pl.DataType) -> Signal:
    """What the file says of a channel that is called ``name`` here."""
    state = dtype == pl.String
    return Signal(
        name=name,
        unit=None if state else unit.strip() or None,
        kind="state" if state else "continuous",
        resample="hold" if state else "linear",
        source_name=source if source != name else None,
        description="" if comment.startswith("<") else comment,
    )


def unique_name(name: str, taken: dict[str, Any]) -> str:
    """``name``, numbered where it is taken."""
    n, unique = 1, name or "channel"
    while unique in taken:
        n += 1
        unique = f"{name}_{n}"
    return unique


def series_of(samples: NDArray[Any], invalid: NDArray[np.bool_] | None) -> pl.Series | None:
    """Samples as a column, invalid ones null; None where a sample is more than one value."""
    if samples.ndim != 1 or samples.dtype.names or samples.dtype.kind not in "biufSUO":
        return None
    if samples.dtype.kind in "SUO":
        different, which = np.unique(
            samples.astype(str) if samples.dtype.kind == "O" else samples, return_inverse=True
        )
        words = [w.decode("utf-8", "replace") if isinstance(w, bytes) else str(w) for w in different.tolist()]
        column = pl.Series([w.rstrip("\0") or None for w in words], dtype=pl.String).gather(which)
    else:
        kind = np.float32 if samples.dtype == np.float16 else samples.dtype.newbyteorder("=")
        column = column_of("", samples.astype(kind, copy=False))
    bits = None if invalid is None else np.asarray(invalid)
    return column if bits is None or not bits.any() else column.set(pl.Series(bits), None)
