from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.gate import GATE, Gate
from stages.stage import ANALYSIS, columns, transform


def gate(t: np.ndarray, **values: np.ndarray) -> np.ndarray:
    log = Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame({"time": t, **values}))})
    return columns(transform([Gate(rate_per_s=dict.fromkeys(values, 0.05))], log))[GATE]


@pytest.mark.parametrize("dt", [0.05, 0.5, 1.0])
def test_the_rate_halves_the_weight_on_any_raster(dt: float) -> None:
    t = np.arange(0, 20, dt)
    np.testing.assert_allclose(gate(t, a=np.exp(0.05 * t))[1:], 0.5)
    np.testing.assert_allclose(gate(t, a=np.full(t.size, 3.0))[1:], 1.0)
    np.testing.assert_allclose(gate(t, a=np.exp(0.05 * t), b=np.exp(-0.05 * t))[1:], 0.25)


def test_a_change_over_a_gap_may_have_come_at_its_end() -> None:
    t = np.array([0.0, 1.0, 30.0, 31.0])
    np.testing.assert_allclose(gate(t, a=np.ones(4))[1:], 1.0)
    np.testing.assert_allclose(gate(t, a=np.exp([0.0, 0.0, 0.1, 0.1]))[1:], [1.0, 0.2, 1.0])


def test_the_first_sample_says_nothing() -> None:
    assert gate(np.array([0.0, 1.0]), a=np.ones(2))[0] == 0.0


def test_rates_are_positive() -> None:
    with pytest.raises(RecipeError, match=r"positive, got {'a': 0"):
        Gate(rate_per_s={"a": 0.0})
