"""A small made-up system: y = f(a, b) with noise, at 10 Hz, and a second group at 2 Hz."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from ingest.log import Group, Log, Signal
from ingest.physics import zero_order_hold


def make_log(seed: int = 0, *, duration_s: float = 300.0, shift: float = 0.0, onset_s: float = 150.0) -> Log:
    """``y = sin(3 a) + a b + noise`` with slowly varying a, b in [0, 1]; from ``onset_s`` on y reads
    ``shift`` more."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration_s, 0.1)
    slow = np.arange(0.0, duration_s, 0.5)
    a = 0.5 + 0.5 * np.sin(2 * np.pi * t / 37 + rng.uniform(0, 6)) * np.cos(
        2 * np.pi * t / 11 + rng.uniform(0, 6)
    )
    b = 0.5 + 0.5 * np.sin(2 * np.pi * slow / 23 + rng.uniform(0, 6))
    y = np.sin(3 * a) + a * np.interp(t, slow, b) + rng.normal(0, 0.02, t.size) + shift * (t >= onset_s)
    fast = Group(
        "fast",
        pl.DataFrame({"time": t, "a": a, "y": y}),
        {"a": Signal(name="a", unit="1"), "y": Signal(name="y", unit="V")},
    )
    return Log(f"made{seed}", {"fast": fast, "slow": Group("slow", pl.DataFrame({"time": slow, "b": b}))})


def _sensor_on_a_lag(tau: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Plant state and reading, driven by u and a disturbance between them."""
    A = np.array([[-2.0, 0.0], [1.0 / tau, -1.0 / tau]])
    return zero_order_hold(A, np.array([[2.0, 0.0], [0.0, 1.0 / tau]]), 0.01)


def sensor_log(
    seed: int = 0, *, duration_s: float = 300.0, tau: float = 0.0, gain: float = 0.0, onset_s: float = 150.0
) -> Log:
    """A lag of 0.5 s watched by a sensor with a lag of 20 ms, at 100 Hz, both driven as a Monitor supposes.

    From ``onset_s`` on the sensor's time constant and gain are ``1 + tau`` and ``1 + gain`` times the
    healthy ones."""
    rng = np.random.default_rng(seed)
    n = round(duration_s * 100)
    u = np.repeat(rng.uniform(0.0, 2.0, n // 50 + 1), 50)[:n]
    inputs = np.stack([u, rng.normal(0, 0.02, n)], axis=1)
    systems = [_sensor_on_a_lag(0.02 * k) for k in (1.0, 1.0 + tau)]
    y, x = np.empty(n), np.zeros(2)
    for t in range(n):
        faulty = t >= onset_s * 100
        y[t] = x[1] * (1.0 + gain * faulty)
        A, B = systems[int(faulty)]
        x = A @ x + B @ inputs[t]
    y += rng.normal(0, 0.005, n)
    frame = pl.DataFrame({"time": np.arange(n) / 100, "u": u, "y": y})
    return Log(f"sensor{seed}", {"bench": Group("bench", frame, {"y": Signal(name="y", unit="V")})})


@pytest.fixture(scope="session")
def make_sensor_log() -> Callable[..., Log]:
    return sensor_log


@pytest.fixture(scope="session")
def healthy_sensor() -> Log:
    return sensor_log(4)


@pytest.fixture(scope="session")
def slow_sensor() -> Log:
    return sensor_log(3, tau=1.0)


@pytest.fixture(scope="session")
def healthy() -> Log:
    return make_log(1)


@pytest.fixture(scope="session")
def faulty() -> Log:
    return make_log(2, shift=0.1)
