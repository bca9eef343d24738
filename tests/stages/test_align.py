"""Align against closed forms: linear signals come back exactly, and nothing appears where nothing was."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import Group, Log, Signal
from stages.align import Align
from stages.stage import ANALYSIS, transform

Array = NDArray[np.float64]


def log_of(**groups: tuple[Array, dict[str, Array]]) -> Log:
    return Log("x", {k: Group(k, pl.DataFrame({"time": t, **signals})) for k, (t, signals) in groups.items()})


def aligned(log: Log, **settings: object) -> pl.DataFrame:
    return transform([Align(**settings)], log).groups[ANALYSIS].frame  # type: ignore[arg-type]


@given(st.lists(st.floats(0.01, 1.5), min_size=3, max_size=40), st.floats(-3, 3))
def test_a_line_stays_a_line_on_any_raster(steps: list[float], slope: float) -> None:
    t = np.cumsum(steps)
    lead = np.arange(0.0, 20.0, 0.37)
    frame = aligned(log_of(a=(lead, {"a": lead}), b=(t, {"b": slope * t})), signals=("a", "b"))
    known = frame.drop_nulls()
    np.testing.assert_allclose(known["b"].to_numpy(), slope * known["time"].to_numpy(), atol=1e-9)
    inside = (lead >= t[0]) & (lead <= t[-1])
    assert known.height == inside.sum()  # never extrapolated, never dropped


def test_going_down_takes_the_mean_and_equal_rates_do_not() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    frame = aligned(log_of(a=(t, {"a": t})), signals=("a",), raster_s=1.0)
    row = frame.filter(pl.col("time") == 5.0)
    assert row["a"].item() == pytest.approx(np.mean([4.1, 4.2, 4.3, 4.4, 4.5, 4.6, 4.7, 4.8, 4.9, 5.0]))
    shifted = np.arange(0.3, 10.0, 1.0)  # the raster's own rate, another phase: interpolated, not displaced
    frame = aligned(log_of(a=(shifted, {"a": shifted})), signals=("a",), raster_s=1.0)
    np.testing.assert_allclose(frame["a"].to_numpy(), frame["time"].to_numpy())


def test_gaps_stay_gaps() -> None:
    t = np.concatenate([np.arange(0.0, 5.0, 0.1), np.arange(20.0, 25.0, 0.1)])
    for raster in (0.0, 0.5):
        frame = aligned(log_of(a=(t, {"a": np.sin(t)})), signals=("a",), raster_s=raster)
        assert frame.filter(pl.col("time").is_between(5.01, 19.99)).is_empty()


def test_a_group_that_starts_late_or_ends_early_is_missing_there() -> None:
    t = np.arange(0.0, 30.0, 0.5)
    part = t[(t >= 10) & (t <= 20)]
    frame = aligned(log_of(a=(t, {"a": t}), b=(part + 0.1, {"b": part})), signals=("a", "b"))
    known = frame.filter(pl.col("b").is_not_null())["time"]
    assert known.min() == 10.5
    assert known.max() == 20.0


def test_states_are_held_and_only_for_so_long() -> None:
    t = np.arange(0.0, 10.0, 0.5)
    gear = Group(
        "g", pl.DataFrame({"time": [0.9, 4.2], "gear": [1, 2]}), {"gear": Signal(name="gear", kind="state")}
    )
    log = Log("x", {"a": Group("a", pl.DataFrame({"time": t, "a": t})), "g": gear})
    frame = aligned(log, signals=("a", "gear"), max_gap_s=2.0)
    expected = [None] * 2 + [1.0] * 4 + [None] * 3 + [2.0] * 4 + [None] * 7
    assert frame["gear"].to_list() == expected


def test_unsorted_and_duplicate_stamps() -> None:
    log = log_of(a=(np.array([0.0, 1.0, 3.0, 2.0, 3.0]), {"a": np.array([0.0, 1.0, 3.0, 2.0, 5.0])}))
    assert aligned(log, signals=("a",))["a"].to_list() == [0.0, 1.0, 2.0, 5.0]
    assert aligned(log, signals=("a",), duplicates="first")["a"].to_list() == [0.0, 1.0, 2.0, 3.0]
    assert aligned(log, signals=("a",), duplicates="mean")["a"].to_list() == [0.0, 1.0, 2.0, 4.0]


def test_irregular_logs_keep_their_own_stamps() -> None:
    t = np.cumsum(np.random.default_rng(3).exponential(0.15, 500))
    frame = aligned(log_of(a=(t, {"a": np.sin(t), "b": np.cos(t)})), signals=("a", "b"))
    np.testing.assert_array_equal(frame["time"].to_numpy(), t)
    np.testing.assert_array_equal(frame["b"].to_numpy(), np.cos(t))


def test_mistakes_are_named() -> None:
    t = np.arange(3.0)
    with pytest.raises(LogError, match="no signal 'p_Bts'; did you mean p_Bst"):
        aligned(log_of(a=(t, {"p_Bst": t})), signals=("p_Bts",))
    words = Log("x", {"a": Group("a", pl.DataFrame({"time": t, "a": ["x", "y", "z"]}))})
    with pytest.raises(LogError, match="String, not numbers"):
        aligned(words, signals=("a",))
    with pytest.raises(RecipeError, match="raster_s = -1"):
        Align(signals=("a",), raster_s=-1)
