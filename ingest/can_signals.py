"""CAN frames to signals as a DBC describes them, all frames of a message at once.

A frame's data are bits; bit ``8 i + j`` is bit ``j`` (0: lowest) of byte ``i``. An Intel signal takes
consecutive bits upwards from its start, a Motorola one goes down from its highest bit and on at bit 7 of the
next byte. ``value = scale * raw + offset``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Signal


def bit_numbers(start: int, length: int, byte_order: str) -> list[int]:
    """The bits of a signal, lowest first.

    >>> bit_numbers(4, 6, "little_endian"), bit_numbers(1, 4, "big_endian")
    ([4, 5, 6, 7, 8, 9], [14, 15, 0, 1])
    """
    if byte_order == "little_endian":
        return list(range(start, start + length))
    bits = [start]
    while len(bits) < length:
        bits.append(bits[-1] + 15 if bits[-1] % 8 == 0 else bits[-1] - 1)
    return bits[::-1]


def decode(message: Any, data: NDArray[np.uint8], sizes: NDArray[np.int64]) -> dict[str, pl.Series]:
    """Signal -> values; null where a frame is too short or the multiplexer has another signal there.

    ``message`` is one of ``cantools``; ``data``: shape (frames, bytes); ``sizes``: length of each frame.
    """
    bits = np.unpackbits(data, axis=1, bitorder="little")
    raw = {s.name: _raw(s, bits) for s in message.signals}
    found = {}
    for signal in message.signals:
        highest = max(bit_numbers(signal.start, signal.length, signal.byte_order))
        there = sizes * 8 > highest
        for name, ids in _switches(message, signal):
            there = there & np.isin(raw[name], np.array(ids, raw[name].dtype))
        values = raw[signal.name] * float(signal.scale) + float(signal.offset)
        exact = signal.scale == 1 and signal.offset == 0
        column = pl.Series(signal.name, raw[signal.name] if exact else values)
        found[signal.name] = column if there.all() else column.set(pl.Series(~there), None)
    return found


def describe(message: Any) -> dict[str, Signal]:
    """What the DBC says of each signal."""
    found = {}
    for s in message.signals:
        words = "; ".join(f"{int(k)}: {v}" for k, v in (s.choices or {}).items())
        state = bool(s.choices) or s.length == 1
        found[s.name] = Signal(
            name=s.name,
            unit=s.unit or None,
            kind="state" if state else "continuous",
            resample="hold" if state else "linear",
            description=" ".join(t for t in (s.comment or "", words) if t),
        )
    return found


def _raw(signal: Any, bits: NDArray[np.uint8]) -> NDArray[Any]:
    numbers = bit_numbers(signal.start, signal.length, signal.byte_order)
    value = np.zeros(len(bits), np.uint64)
    for place, number in enumerate(numbers):
        if number < bits.shape[1]:
            value |= bits[:, number].astype(np.uint64) << np.uint64(place)
    if signal.is_float:
        return value.astype({16: "<u2", 32: "<u4", 64: "<u8"}[signal.length]).view(f"<f{signal.length // 8}")
    if not signal.is_signed:
        return value
    shift = np.uint64(64 - signal.length)
    return (value << shift).view(np.int64) >> np.int64(shift)


def _switches(message: Any, signal: Any) -> list[tuple[str, Sequence[int]]]:
    """The multiplexers a signal hangs on, and the values at which it is there."""
    found: list[tuple[str, Sequence[int]]] = []
    while signal.multiplexer_ids is not None and signal.multiplexer_signal:
        found.append((signal.multiplexer_signal, signal.multiplexer_ids))
        signal = message.get_signal_by_name(signal.multiplexer_signal)
    return found
