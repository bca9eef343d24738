"""Samples of MDF channels as columns of a table."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray


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
        column = pl.Series(samples.astype(kind, copy=False))
    bits = None if invalid is None else np.asarray(invalid)
    return column if bits is None or not bits.any() else column.set(pl.Series(bits), None)
