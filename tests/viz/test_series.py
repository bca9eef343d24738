from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from viz.series import break_at_gaps, changes, envelope, lane, limits, spans, tick_step, usual_step

Array = NDArray[np.float64]
numbers = st.floats(-1e6, 1e6) | st.just(float("nan"))
columns = st.integers(1, 400).flatmap(lambda n: arrays(np.float64, (n, 2), elements=numbers))


def same_extremes(a: Array, b: Array) -> bool:
    return bool(np.array_equal(np.fmin.reduce(a), np.fmin.reduce(b), equal_nan=True)) and bool(
        np.array_equal(np.fmax.reduce(a), np.fmax.reduce(b), equal_nan=True)
    )


@given(columns, st.integers(4, 100))
def test_envelope_keeps_extremes_order_and_breaks(values: Array, points: int) -> None:
    time = np.arange(len(values), dtype=float)
    t, v = envelope(time, values, points)
    assert same_extremes(values, v)
    assert (np.diff(t) > 0).all()
    assert set(t) <= set(time)
    empty = np.asarray(np.isnan(values).all(axis=1))
    stretches = len(changes(empty))
    assert len(changes(np.asarray(np.isnan(v).all(axis=1)))) == stretches
    assert len(t) <= max(points + 2, 0) + 2 * stretches


def test_envelope_keeps_a_peak_in_its_bucket_at_full_height() -> None:
    values = np.zeros((100_000, 1))
    values[54_321] = 10.0
    t, v = envelope(np.arange(100_000.0), values, 1000)
    peak = t[v[:, 0] == 10.0]
    assert peak.size == 1
    assert abs(peak[0] - 54_321) <= 200
    assert t.size <= 1002


def test_envelope_gives_least_and_greatest_in_their_order() -> None:
    saw = np.tile([0.0, 3.0, -2.0, 1.0], 50)[:, None]
    _, v = envelope(np.arange(200.0), saw, 100)
    assert v[:2, 0].tolist() == [3.0, -2.0]
    _, v = envelope(np.arange(200.0), -saw, 100)
    assert v[:2, 0].tolist() == [-3.0, 2.0]


def test_short_series_pass_unchanged() -> None:
    t, v = envelope(np.arange(5.0), np.eye(5), 5)
    assert (t == np.arange(5.0)).all()
    assert (v == np.eye(5)).all()


def test_a_gap_becomes_one_empty_row_inside_it() -> None:
    time = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(20.0, 30.0, 0.1)])
    t, v = break_at_gaps(time, np.ones((time.size, 2)))
    rows = np.flatnonzero(np.isnan(v[:, 0]))
    assert rows.tolist() == [100]
    assert 9.9 < t[100] < 20.0
    assert (np.diff(t) > 0).all()


def test_steady_and_bursty_sampling_have_no_gaps() -> None:
    rng = np.random.default_rng(0)
    for steps in (np.full(500, 0.01), rng.uniform(0.005, 0.02, 500), np.tile([0.0, 0.0, 0.0, 0.1], 100)):
        t, _ = break_at_gaps(np.cumsum(steps), np.ones((steps.size, 1)))
        assert t.size == steps.size


@given(st.lists(st.sampled_from(["", "a", "b"]), min_size=1, max_size=60))
def test_lane_says_the_same_as_the_rows(states: list[str]) -> None:
    time = np.arange(len(states), dtype=float)
    at, names = lane(time, np.array(states))
    assert names[-1] == ""
    held = [names[np.searchsorted(at, t, side="right") - 1] for t in time]
    assert held == states


def test_lane_ends_at_gaps_and_at_the_end() -> None:
    time = np.concatenate([np.arange(10.0), np.arange(100.0, 110.0)])
    at, names = lane(time, np.array(["on"] * 20))
    assert list(zip(at.tolist(), names, strict=True)) == [(0.0, "on"), (10.0, ""), (100.0, "on"), (110.0, "")]


def test_nothing_gives_nothing() -> None:
    none = np.zeros(0)
    assert lane(none, np.zeros(0, dtype=str))[1] == []
    assert spans(none, np.zeros(0, dtype=bool)) == []
    assert usual_step(none) == 0.0
    assert break_at_gaps(none, np.zeros((0, 3)))[1].shape == (0, 3)


@given(arrays(np.bool_, st.integers(1, 50)))
def test_spans_hold_exactly_the_true_rows(active: NDArray[np.bool_]) -> None:
    time = np.arange(active.size, dtype=float)
    inside = np.zeros_like(active)
    for start, end in spans(time, active):
        inside |= (time >= start) & ((time < end) | ((end == time[-1]) & active[-1] & (time <= end)))
    assert (inside == active).all()


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_limits_hold_the_values_on_whole_ticks(a: float, b: float) -> None:
    low, high = limits(min(a, b), max(a, b))
    slack = 1e-9 * max(abs(a), abs(b), 1.0)
    assert low - slack <= min(a, b) <= max(a, b) <= high + slack
    assert high > low
    assert 2 <= (high - low) / tick_step(low, high) <= 12


def test_limits_of_what_has_no_scale() -> None:
    assert limits(-np.inf, np.inf) == (-np.inf, np.inf)
    assert limits(1e300, 1e300) == (1e300, 1e300)
