"""Compensate: what a healthy sensor would have read, once a fault of the sensor is isolated (3.2.4).

While a sensor fault has at least ``confidence``, the readings y are corrected with its size, taken from the
last window that ended before the sample and continued along its trend; else they pass unchanged.

    gain           y / (1 + m)
    time constant  (tau s + 1) / (tau_0 s + 1) y, tau = (1 + m) tau_0; for an input held from sample to sample
                   c(t) = a_0 c(t-1) + (1 - a_0) / (1 - a) (y(t) - a y(t-1)),    a = exp(-dt / tau)

The second amplifies the measurement noise by ``(1 - a_0)^2 / (1 - a)^2 (1 + (a_0 - a)^2 / (1 - a_0^2))`` in
variance; ``corrected_sd`` has both, the noise and the doubt about m.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
import polars as pl
from numba import njit
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import TIME, Log, Signal
from stages.monitor import INDICATOR, NOISE, RATE, SIGNALS
from stages.residuals import SIGMA, Z
from stages.results import PROBABILITY, SIZE, SIZE_SD
from stages.stage import ANALYSIS

Array = NDArray[np.float64]
CORRECTED, CORRECTED_SD = ".corrected", ".corrected_sd"


@dataclass(frozen=True, eq=False)
class CompensateState:
    """The last window's row, and time, reading and corrected reading of the last sample."""

    row: Mapping[str, float] = field(default_factory=dict)
    last: tuple[float, float, float] = (np.nan, np.nan, np.nan)


@dataclass(frozen=True, kw_only=True)
class Compensate:
    """``signal``: the sensor's reading; ``sensor``: its name among the monitor's indicators
    (``tau_<sensor>``); ``faults``: which faults are corrected, and how: ``"gain"`` or ``"time_constant"``.

    Raises:
        RecipeError: no faults, or a confidence that is not a probability.
    """

    version: ClassVar[str] = "1"
    signal: str
    sensor: str
    faults: Mapping[str, Literal["gain", "time_constant"]]
    confidence: float = 0.95
    max_gap_s: float = 0.01

    def __post_init__(self) -> None:
        if not self.faults or not 0.0 < self.confidence < 1.0:
            raise RecipeError(
                f"compensate: faults = {dict(self.faults)}, confidence = {self.confidence:g}; expected at "
                "least one fault, and a confidence between 0 and 1"
            )

    @property
    def needs(self) -> set[str]:
        dynamic = "time_constant" in self.faults.values()
        tau = {kind + f"tau_{self.sensor}" for kind in (INDICATOR, SIGMA, Z) if dynamic}
        return {NOISE} | tau | {kind + f for f in self.faults for kind in (PROBABILITY, SIZE, SIZE_SD, RATE)}

    @property
    def adds(self) -> set[str]:
        return {self.signal + CORRECTED, self.signal + CORRECTED_SD}

    def start(self) -> CompensateState:
        return CompensateState()

    def step(self, state: CompensateState, block: Log, /) -> tuple[CompensateState, Log]:
        group = block.groups[SIGNALS]
        frame = block.groups[ANALYSIS].frame
        rows: list[Mapping[str, float]] = [state.row]
        for window in frame.select(TIME, *sorted(self.needs)).to_dicts():
            known = {k: v for k, v in window.items() if v is not None}
            rows.append({**rows[-1], **known})  # one that could not be fitted keeps the rest
        time = group.time
        y = group.frame[self.signal].cast(pl.Float64).fill_null(np.nan).to_numpy()
        edges = [0, *np.searchsorted(time, frame[TIME].to_numpy() - 1e-9).tolist(), time.size]
        corrected, sd, last = y.copy(), np.full(time.size, np.nan), state.last
        for row, first, end in zip(rows, edges, edges[1:], strict=False):
            if end > first:
                part = slice(first, end)
                corrected[part], sd[part] = self._correct(row, time[part], y[part], last)
                last = (float(time[end - 1]), float(y[end - 1]), float(corrected[end - 1]))
        unit = group.signals[self.signal].unit
        added = {self.signal + CORRECTED: corrected, self.signal + CORRECTED_SD: sd}
        signals = {n: Signal(name=n, unit=unit) for n in added}
        group = replace(
            group,
            frame=group.frame.with_columns(pl.Series(n, v) for n, v in added.items()),
            signals={**group.signals, **signals},
        )
        return CompensateState(rows[-1], last), replace(block, groups={**block.groups, SIGNALS: group})

    def _correct(
        self, row: Mapping[str, float], time: Array, y: Array, last: tuple[float, float, float]
    ) -> tuple[Array, Array]:
        """Corrected readings and their standard deviation, of samples that the window ``row`` speaks for."""
        noise = row.get(NOISE)
        noise = np.nan if noise is None else noise
        fault = max(self.faults, key=lambda f: row.get(PROBABILITY + f) or 0.0)
        if not (row.get(PROBABILITY + fault) or 0.0) >= self.confidence:
            return y, np.full(y.size, noise)
        elapsed = time - row[TIME]
        eta = np.log1p(row[SIZE + fault]) + row[RATE + fault] * elapsed
        eta_sd = row[SIZE_SD + fault] / (1.0 + row[SIZE + fault])
        if self.faults[fault] == "gain":
            corrected = y * np.exp(-eta)
            return corrected, np.hypot(corrected * eta_sd, noise * np.exp(-eta))
        tau = f"tau_{self.sensor}"
        healthy = row[INDICATOR + tau] - row[Z + tau] * row[SIGMA + tau]
        dt = np.diff(time, prepend=last[0])
        dt = np.where(dt <= self.max_gap_s, dt, np.inf)  # the first sample, and after a gap: start anew
        a, a_0 = np.exp(-dt / (healthy * np.exp(eta))), np.exp(-dt / healthy)
        corrected = _lead(y, a, a_0, last[1], last[2])
        with np.errstate(invalid="ignore"):
            amplified = (1 - a_0) / (1 - a) * np.sqrt(1 + (a_0 - a) ** 2 / (1 - a_0**2))
            doubt = (corrected - y) * eta_sd / -np.expm1(-eta)
        return corrected, np.hypot(np.nan_to_num(doubt), noise * amplified)


@njit(cache=True)
def _lead(
    y: Array, a: Array, a_0: Array, y_before: float, c_before: float
) -> Array:  # pragma: no cover - compiled
    """The second filter; a sample without a predecessor (a = 0) passes, a missing one stays missing."""
    c = np.empty(y.size)
    for t in range(y.size):
        if np.isnan(y_before) or a[t] == 0.0:
            c[t] = y[t]
        else:
            c[t] = a_0[t] * c_before + (1.0 - a_0[t]) / (1.0 - a[t]) * (y[t] - a[t] * y_before)
        y_before, c_before = y[t], c[t]
    return c
