"""Gate: how far a sample is from steady state, since the detectors' relations are static ones.

``gate = prod_i 1 / (1 + (d ln x_i / dt / rate_i)^2)``, in (0, 1]: 1 at rest, 1/2 where one signal changes at
its ``rate``. The derivative is the causal difference to the previous sample, whatever the raster; over a
step longer than ``within_s`` the change may have come at its end, so it is taken as if it had come within
that time. The first sample says nothing: 0. Detectors weigh their training samples by the gate, and a
residual's spread grows as ``1 / sqrt(gate)`` (:mod:`stages.residuals`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ingest.errors import RecipeError
from ingest.log import TIME, Log
from stages.stage import add_columns, columns

GATE = "gate"


@dataclass(frozen=True)
class GateState:
    """The last sample: time, and logarithms or values."""

    time: float = np.nan
    log: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Gate:
    """``rate_per_s`` maps a signal to the relative rate of change (1/s) that halves the weight,
    ``change_per_s`` one to the absolute rate (its unit per s), where it is known.

    Raises:
        RecipeError: a rate is not positive.
    """

    version: ClassVar[str] = "2"
    rate_per_s: Mapping[str, float]
    change_per_s: Mapping[str, float] = field(default_factory=dict)
    within_s: float = 1.0

    def __post_init__(self) -> None:
        rates = {**self.rate_per_s, **self.change_per_s}
        if bad := {n: r for n, r in rates.items() if not r > 0}:
            raise RecipeError(f"gate: rates must be positive, got {bad}")

    @property
    def needs(self) -> set[str]:
        return {*self.rate_per_s, *self.change_per_s}

    @property
    def adds(self) -> set[str]:
        return {GATE}

    def start(self) -> GateState:
        return GateState()

    def step(self, state: GateState, block: Log, /) -> tuple[GateState, Log]:
        values = columns(block, [TIME, *self.rate_per_s, *self.change_per_s])
        time = values[TIME]
        if not time.size:
            return state, add_columns(block, {GATE: np.empty(0)})
        dt = np.diff(time, prepend=state.time)
        gate, last = np.ones(time.size), {}
        for name, rate in self.rate_per_s.items():
            log = np.log(np.maximum(values[name], 1e-12))
            slope = np.diff(log, prepend=state.log.get(name, np.nan)) / np.minimum(dt, self.within_s)
            gate /= 1.0 + (slope / rate) ** 2
            last[name] = float(log[-1])
        for name, rate in self.change_per_s.items():
            slope = np.diff(values[name], prepend=state.log.get(name, np.nan)) / np.minimum(dt, self.within_s)
            gate /= 1.0 + np.nan_to_num(slope / rate) ** 2
            last[name] = float(values[name][-1])
        gate = np.nan_to_num(gate, nan=0.0)
        return GateState(float(time[-1]), last), add_columns(block, {GATE: gate}, {GATE: "1"})
