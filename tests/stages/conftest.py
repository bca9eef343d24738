"""A small made-up system: y = f(a, b) with noise, at 10 Hz, and a second group at 2 Hz."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.log import Group, Log, Signal


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


@pytest.fixture(scope="session")
def healthy() -> Log:
    return make_log(1)


@pytest.fixture(scope="session")
def faulty() -> Log:
    return make_log(2, shift=0.1)
