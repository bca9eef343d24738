"""Smooth: causal first-order low-pass filters on an irregular raster.

``y_k = y_(k-1) + (1 - exp(-dt_k / tau_k)) (x_k - y_(k-1))``, the exact step response of
``tau dy/dt + y = x`` for an input held over ``dt_k``. Where ``dt`` is long against ``tau`` the sample passes
unchanged, so a thinned log needs no other settings. ``tau`` may depend on other signals, as in the engine's
own filter ``tau = 180 / n_Eng`` of (5.33).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.log import TIME, Log
from stages.formula import Formula
from stages.stage import add_columns, columns


@dataclass(frozen=True)
class SmoothState:
    """Time of the last sample and the filters' values."""

    time: float = np.nan
    value: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Smooth:
    """``tau_s`` maps a column to its time constant in s (a number or a formula); columns are replaced.

    Raises:
        RecipeError: a formula cannot be read or names an unknown column.
    """

    version: ClassVar[str] = "1"
    tau_s: Mapping[str, float | str]

    def __post_init__(self) -> None:
        assert self.formulas is not None

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        return {name: Formula(str(text)) for name, text in self.tau_s.items()}

    @property
    def needs(self) -> set[str]:
        return set(self.tau_s).union(*(f.names for f in self.formulas.values()))

    @property
    def adds(self) -> set[str]:
        return set()

    def start(self) -> SmoothState:
        return SmoothState()

    def step(self, state: SmoothState, block: Log, /) -> tuple[SmoothState, Log]:
        values = columns(block)
        time = values[TIME]
        if not time.size:
            return state, block
        dt = np.diff(time, prepend=state.time)
        smoothed, last = {}, {}
        for name, formula in self.formulas.items():
            tau = np.broadcast_to(formula(values), time.shape)
            gain = np.where(np.isfinite(dt / tau), -np.expm1(-dt / np.where(tau > 0, tau, 1e-9)), 1.0)
            smoothed[name] = first_order(gain, values[name], state.value.get(name, np.nan))
            known = smoothed[name][np.isfinite(smoothed[name])]
            last[name] = float(known[-1]) if known.size else state.value.get(name, np.nan)
        return SmoothState(float(time[-1]), last), add_columns(block, smoothed)


@njit(cache=True)
def first_order(
    gain: NDArray[np.float64], x: NDArray[np.float64], start: float
) -> NDArray[np.float64]:  # pragma: no cover - compiled
    """``y_k = y_(k-1) + gain_k (x_k - y_(k-1))``; a missing ``x`` gives a missing ``y`` and keeps the
    state."""
    y = np.empty(x.size)
    last = start
    for k in range(x.size):
        if np.isnan(x[k]):
            y[k] = np.nan
            continue
        last = x[k] if np.isnan(last) else last + gain[k] * (x[k] - last)
        y[k] = last
    return y
