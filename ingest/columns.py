"""Arrays of numbers as columns, where they lie."""

from __future__ import annotations

from typing import Any

import polars as pl
import pyarrow as pa
from numpy.typing import NDArray


def column_of(name: str, values: NDArray[Any]) -> pl.Series:
    """``values``, shape (rows,), as a column that shares their memory: they must not be changed any more.

    ``pl.Series`` copies them, and ``pyarrow.array`` imports pandas first.

    >>> import numpy as np
    >>> column_of("x", np.array([1.5, np.nan], np.float32)).to_list()
    [1.5, nan]
    """
    if values.dtype.kind not in "iuf" or not (values.dtype.isnative and values.flags.c_contiguous):
        return pl.Series(name, values)
    kind = pa.from_numpy_dtype(values.dtype)
    return pl.Series(name, pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(values)]))
