"""The two numerical examples of the dissertation's input selection (4.3.1), with their true structure.

Example 1 (4.16), u_1 ~ U(0, 0.5), u_2 ~ U(0, 1), e_1 ~ N(0, 0.01), e_2 ~ N(0, 0.04):

    y_1(t) = 0.8 y_1(t-1) - 0.1 y_2(t-1) + u_1(t-2) + 0.4 u_1^2(t-2) - 1.2 u_1(t-1) u_2(t-2) + e_1(t)
    y_2(t) = 0.5 y_2(t-1) + 0.5 y_2(t-2) u_2^2(t-1) + u_2(t-2) + u_1^2(t-1) + e_2(t)

Example 2 (4.19), u_1, u_2 ~ U(-0.5, 0.5), e ~ N(0, 0.0025), and an input that is a mixture of the others,
u_3 = u_1 + u_2 + e_u with e_u ~ N(0, 0.01):

    y(t) = 0.8 y(t-1) + u_1(t-6) u_2(t-4) + 0.5 exp(0.4 u_1^2(t-6)) + e(t)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
from numba import njit
from numpy.typing import NDArray

from ingest.errors import DynoscopeError
from ingest.log import TIME, Group, Log, Signal
from ingest.simulators.faults import FAULT_FREE

__all__ = ["STRUCTURES", "example1", "example2", "simulate_example"]

Array = NDArray[np.float64]
SETTLE = 200  # samples before the log begins
STREAMS = ("inputs", "noise")

# by output: orders and delays as in `dynoscope select`
STRUCTURES: dict[str, dict[str, Any]] = {
    "example1": {
        "y1": {"na": {"y1": 1, "y2": 1}, "nb": {"u1": 2, "u2": 1}, "nk": {"u1": 1, "u2": 2}},
        "y2": {"na": {"y1": 0, "y2": 2}, "nb": {"u1": 1, "u2": 2}, "nk": {"u1": 1, "u2": 1}},
    },
    "example2": {"y": {"na": {"y": 1}, "nb": {"u1": 1, "u2": 1, "u3": 0}, "nk": {"u1": 6, "u2": 4, "u3": 0}}},
}


def simulate_example(
    system: str, *, n: int = 4000, noise: float = 1.0, seed: int = 0, name: str | None = None
) -> Log:
    """A log of ``n`` samples, 1 s apart, of ``"example1"`` or ``"example2"``; the true structure is the fact
    ``structure``. ``noise`` scales the noise of the outputs.

    Raises:
        DynoscopeError: fewer than one sample, negative noise or seed.

    >>> simulate_example("example2", n=3).values("u1").shape
    (3,)
    """
    if n < 1 or not 0 <= noise < np.inf or seed < 0:
        raise DynoscopeError(
            f"simulate {system}: needs n >= 1, noise >= 0 and seed >= 0, got n = {n}, noise = {noise:g}, "
            f"seed = {seed}"
        )
    columns = {"example1": example1, "example2": example2}[system](n, noise, seed)
    frame = pl.DataFrame({TIME: np.arange(n, dtype=float), **columns})
    signals = {c: Signal(name=c, unit="1") for c in columns}
    facts = {
        "simulator": system, "n": n, "noise": noise, "seed": seed, "structure": STRUCTURES[system],
    }  # fmt: skip
    return Log(name or system, {system: Group(system, frame, signals)}, (FAULT_FREE,), facts)


def example1(n: int, noise: float, seed: int) -> Mapping[str, Array]:
    """Columns ``y1 y2 u1 u2`` of (4.16), shape (n,)."""
    inputs, disturbance = _streams(seed)
    u = inputs.uniform(size=(n + SETTLE, 2)) * np.array([0.5, 1.0])
    e = disturbance.standard_normal((n + SETTLE, 2)) * np.sqrt([0.01, 0.04]) * noise
    y = _example1(u, e)[SETTLE:]
    return {"y1": y[:, 0], "y2": y[:, 1], "u1": u[SETTLE:, 0], "u2": u[SETTLE:, 1]}


def example2(n: int, noise: float, seed: int) -> Mapping[str, Array]:
    """Columns ``y u1 u2 u3`` of (4.19), shape (n,)."""
    inputs, disturbance = _streams(seed)
    u = inputs.uniform(-0.5, 0.5, size=(n + SETTLE, 2))
    mixture = u.sum(axis=1) + 0.1 * inputs.standard_normal(n + SETTLE)
    y = _example2(u, 0.05 * noise * disturbance.standard_normal(n + SETTLE))
    return {"y": y[SETTLE:], "u1": u[SETTLE:, 0], "u2": u[SETTLE:, 1], "u3": mixture[SETTLE:]}


def _streams(seed: int) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, i]) for i in range(len(STREAMS))]


@njit(cache=True)
def _example1(u: Array, e: Array) -> Array:  # pragma: no cover - compiled
    y = np.zeros((len(u), 2))
    for t in range(2, len(u)):
        y[t, 0] = (
            0.8 * y[t - 1, 0] - 0.1 * y[t - 1, 1] + u[t - 2, 0] + 0.4 * u[t - 2, 0] ** 2
            - 1.2 * u[t - 1, 0] * u[t - 2, 1] + e[t, 0]
        )  # fmt: skip
        y[t, 1] = (
            0.5 * y[t - 1, 1] + 0.5 * y[t - 2, 1] * u[t - 1, 1] ** 2 + u[t - 2, 1] + u[t - 1, 0] ** 2
            + e[t, 1]
        )  # fmt: skip
    return y


@njit(cache=True)
def _example2(u: Array, e: Array) -> Array:  # pragma: no cover - compiled
    y = np.zeros(len(u))
    for t in range(6, len(u)):
        y[t] = 0.8 * y[t - 1] + u[t - 6, 0] * u[t - 4, 1] + 0.5 * np.exp(0.4 * u[t - 6, 0] ** 2) + e[t]
    return y
