from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ingest.errors import LogError
from stages.alarm_rate import SPAN_S, peaks, shift_for


def test_peaks_are_the_largest_of_each_span() -> None:
    time = np.arange(0.0, 4.4 * SPAN_S, 0.5)
    x = np.sin(time) - 5.0
    x[10], x[-1] = 7.0, 3.0
    found = peaks(time, x)
    assert len(found) == 4  # the rest goes with the last
    assert (found[0], found[3]) == (7.0, 3.0)
    assert found[1] == pytest.approx(-4.0, abs=0.05)


def test_what_says_nothing_is_no_peak() -> None:
    assert len(peaks(np.empty(0), np.empty(0))) == 0
    assert list(peaks(np.array([0.0, 1.0]), np.array([-np.inf, 2.0]))) == [2.0]
    assert len(peaks(np.array([0.0, 1.0]), np.full(2, np.nan))) == 0


@given(st.integers(0, 1000), st.floats(1.0, 8.0))
def test_the_rate_is_met_on_other_data(seed: int, beta: float) -> None:
    """Of peaks with an exponential tail, twelve an hour."""
    rng = np.random.default_rng(seed)
    x = rng.exponential(beta, size=2400)
    wanted = 0.5
    c = shift_for([x], 2400 / 12, wanted)
    assert 12 * np.exp(-c / beta) == pytest.approx(wanted, rel=0.5)


@given(st.lists(st.floats(-20.0, 20.0), min_size=8, max_size=60))
def test_fewer_alarms_take_higher_thresholds(x: list[float]) -> None:
    found = np.array(x)
    shifts = [shift_for([found], len(x) / 12, rate) for rate in (5.0, 1.0, 0.1, 0.01)]
    assert all(a <= b + 1e-9 for a, b in pairwise(shifts))


def test_too_little_to_say() -> None:
    with pytest.raises(LogError, match=r"cannot be set from 0.58 h .* at least 0.67 h"):
        shift_for([np.zeros(7)], 7 / 12, 1.0)
