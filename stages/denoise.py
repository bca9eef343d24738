"""Denoise: wavelet shrinkage of signals, window by window (3.2.2; Donoho, IEEE Trans. Inf. Theory 41, 1995).

The detail coefficients of a Daubechies-4 transform are shrunk towards zero by the universal threshold
``sigma sqrt(2 ln N)``, sigma from the median of the finest ones. Needs PyWavelets (``dynoscope[wavelets]``).

Not for the monitor's signals: it helps a full-rate subspace model to the slow poles (error of the 29 ms pole
68 -> 5 %), but takes away the process disturbance from which the sensor is known: the monitor then finds
3.6e-4 s for a time constant of 2e-4 s, and a slower sensor looks weaker (``benchmarks/throttle.py --part
7``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import Log
from stages.stage import ANALYSIS

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Denoise:
    """``columns`` are replaced, in windows of ``samples`` rows; what does not fill one at the end is dropped.

    A window with a missing value passes unchanged.

    Raises:
        RecipeError: no columns, windows of less than 16 samples, or PyWavelets is not installed.
    """

    version: ClassVar[str] = "1"
    columns: tuple[str, ...]
    samples: int

    def __post_init__(self) -> None:
        if not self.columns or self.samples < 16:
            raise RecipeError(
                f"denoise: columns = {list(self.columns)}, samples = {self.samples}; expected at least one "
                "column, and windows of 16 samples or more"
            )

    @property
    def needs(self) -> set[str]:
        return set(self.columns)

    @property
    def adds(self) -> set[str]:
        return set()

    def start(self) -> pl.DataFrame | None:
        """Rows that do not fill a window yet."""
        return None

    def step(self, state: pl.DataFrame | None, block: Log, /) -> tuple[pl.DataFrame, Log]:
        group = block.groups[ANALYSIS]
        rows = group.frame if state is None else pl.concat([state, group.frame])
        whole = rows.height // self.samples * self.samples
        ready = rows.head(whole).with_columns(
            pl.Series(c, self._denoised(rows[c].head(whole).cast(pl.Float64).fill_null(np.nan).to_numpy()))
            for c in self.columns
        )
        return rows.slice(whole), replace(
            block, groups={**block.groups, ANALYSIS: replace(group, frame=ready)}
        )

    def _denoised(self, x: Array) -> Array:
        windows = x.reshape(-1, self.samples)
        return np.concatenate([x[:0], *(w if np.isnan(w).any() else shrink(w) for w in windows)])


def shrink(x: Array) -> Array:
    """x (n,) with soft universal thresholding of its wavelet details.

    Raises:
        RecipeError: PyWavelets is not installed.
    """
    try:
        import pywt
    except ImportError:
        raise RecipeError("denoise needs PyWavelets: pip install 'dynoscope[wavelets]'") from None
    coarse, *details = pywt.wavedec(np.array(x), "db4")  # it wants to be allowed to write
    sigma = float(np.median(np.abs(details[-1]))) / 0.6745
    threshold = sigma * np.sqrt(2.0 * np.log(x.size))
    shrunk = [np.sign(d) * np.maximum(np.abs(d) - threshold, 0.0) for d in details]
    return np.asarray(pywt.waverec([coarse, *shrunk], "db4")[: x.size], dtype=np.float64)
