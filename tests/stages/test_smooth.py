from __future__ import annotations

import numpy as np
import polars as pl
from hypothesis import given
from hypothesis import strategies as st

from ingest.log import Group, Log
from stages.smooth import Smooth
from stages.stage import ANALYSIS, columns, transform


def block(t: np.ndarray, **values: np.ndarray) -> Log:
    return Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame({"time": t, **values}))})


@given(st.lists(st.floats(0.001, 3.0), min_size=2, max_size=60), st.floats(0.05, 5.0))
def test_step_response_is_exact_on_any_raster(steps: list[float], tau: float) -> None:
    t = np.concatenate([[0.0], np.cumsum(steps)])
    x = np.concatenate([[0.0], np.ones(len(steps))])
    y = columns(transform([Smooth(tau_s={"a": tau})], block(t, a=x)))["a"]
    np.testing.assert_allclose(y, 1 - np.exp(-t / tau), atol=1e-9)


def test_the_time_constant_may_depend_on_a_signal() -> None:
    t = np.arange(0, 3, 0.02)
    n = np.full(t.size, 900.0)
    y = columns(transform([Smooth(tau_s={"W": "180 / n"})], block(t, W=(t > 0).astype(float), n=n)))["W"]
    np.testing.assert_allclose(y, 1 - np.exp(-t / 0.2), atol=1e-9)


def test_a_missing_sample_is_missing_and_forgotten() -> None:
    t = np.arange(4.0)
    y = columns(transform([Smooth(tau_s={"a": 1e-3})], block(t, a=np.array([1.0, np.nan, np.nan, 4.0]))))["a"]
    np.testing.assert_allclose(y, [1.0, np.nan, np.nan, 4.0])
