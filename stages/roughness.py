"""Roughness: how much a signal scatters from sample to sample, before averaging hides it.

Of second differences, that a slow change leaves out, at the log's own rate:

    rough_k = (x_k - 2 x_(k-1) + x_(k-2))^2 / 6,

whose mean is the variance where the noise is white; 0 where there are no two samples before, or they are too
long ago (a missing value would make the averaging slower, and two zeros in an average say little). Columns
``rough.<signal>`` (its unit squared), and ``sample_s``, the time since the sample before: both become means
where `align` averages them, so that the stage `sensors` can judge the noise of a signal, and only at the rate
that it learned it at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import TIME, Log
from stages.stage import add_columns, columns

Array = NDArray[np.float64]
ROUGH, SAMPLE_S = "rough.", "sample_s"


@dataclass(frozen=True, eq=False)
class RoughnessState:
    """Times of the last two samples, shape (2,), and their readings, (signals, 2)."""

    time: Array
    x: Array


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """``signals``: those to look at; samples more than ``max_gap_s`` apart are not compared.

    Raises:
        RecipeError: no signals, or a gap that is not positive.
    """

    version: ClassVar[str] = "1"
    signals: tuple[str, ...]
    max_gap_s: float = 1.0

    def __post_init__(self) -> None:
        if not self.signals or not self.max_gap_s > 0:
            raise RecipeError(
                f"roughness: signals = {list(self.signals)}, max_gap_s = {self.max_gap_s:g}; expected "
                "at least one signal, and a time above 0"
            )

    @property
    def needs(self) -> set[str]:
        return {*self.signals}

    @property
    def adds(self) -> set[str]:
        return {SAMPLE_S} | {ROUGH + s for s in self.signals}

    def start(self) -> RoughnessState:
        return RoughnessState(np.full(2, np.nan), np.full((len(self.signals), 2), np.nan))

    def step(self, state: RoughnessState, block: Log, /) -> tuple[RoughnessState, Log]:
        values = columns(block, [TIME, *self.signals])
        time = np.concatenate([state.time, values[TIME]])
        dt = np.diff(time)
        apart = ~(np.maximum(dt[1:], dt[:-1]) <= self.max_gap_s)
        added, last = {SAMPLE_S: np.where(np.isfinite(dt[1:]), dt[1:], 0.0)}, np.empty_like(state.x)
        for i, name in enumerate(self.signals):
            x = np.concatenate([state.x[i], values[name]])
            last[i] = x[-2:]
            d = np.diff(x)
            d = d[1:] - d[:-1]
            d *= d
            d /= 6.0
            d[apart] = 0.0
            added[ROUGH + name] = d
        units = {SAMPLE_S: "s"} | {ROUGH + s: _squared(block.signals[s].unit) for s in self.signals}
        return RoughnessState(time[-2:], last), add_columns(block, added, units)


def _squared(unit: str | None) -> str:
    return f"({unit})^2" if unit and unit != "1" else "1"
