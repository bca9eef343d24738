from __future__ import annotations

import numpy as np
import pytest

from stages.drifting import drift_of


def test_without_a_change_nothing_is_found() -> None:
    """Of 200 series of 120 drives."""
    rng = np.random.default_rng(0)
    found = [drift_of(rng.normal(size=120)) for _ in range(200)]
    assert sum(len(d.segments) > 1 for d in found) <= 4
    assert sum(d.noticed is not None for d in found) <= 4


@pytest.mark.parametrize("step", [2.0, -3.0])
def test_a_step_is_found_where_it_was(step: float) -> None:
    rng = np.random.default_rng(1)
    places, noticed = [], []
    for _ in range(100):
        x = 5.0 + rng.normal(size=100)
        x[60:] += step
        d = drift_of(x)
        places.append(d.segments[1].first if len(d.segments) == 2 else -100)
        noticed.append(d.noticed if d.noticed is not None else 1000)
        assert d.segments[0].first == 0
        assert d.segments[-1].last == 99
    assert np.mean(np.abs(np.array(places) - 60) <= 2) > 0.9
    assert np.mean((np.array(noticed) >= 60) & (np.array(noticed) < 75)) > 0.8


def test_a_slow_drift_moves_by_what_it_moved() -> None:
    rng = np.random.default_rng(2)
    x = np.linspace(0, 6, 150) + rng.normal(size=150)
    d = drift_of(x)
    assert d.moved == pytest.approx(5.0, abs=1.5)  # the segments' means, not the ends
    assert d.noise == pytest.approx(1.0, rel=0.3)


def test_missing_drives_do_not_count() -> None:
    x = np.r_[np.zeros(10), np.full(10, 9.0)] + 0.1 * np.random.default_rng(3).normal(size=20)
    holes = np.insert(x, [5, 12], np.nan)
    (one, two) = drift_of(holes).segments
    assert (one.last, two.first) == (10, 11)
    assert drift_of(np.full(4, np.nan)).segments == ()
    assert drift_of(np.array([1.0, np.nan, 2.0])).moved == 0.0


def test_the_cuts_are_those_of_the_least_cost() -> None:
    """Against all pairs of cuts."""
    rng = np.random.default_rng(4)
    x = np.r_[rng.normal(size=8), rng.normal(6, 1, size=9), rng.normal(-3, 1, size=7)]
    found = [s.first for s in drift_of(x).segments[1:]]

    def cost(a: int, b: int) -> float:
        return sum(float(((p - p.mean()) ** 2).sum()) for p in (x[:a], x[a:b], x[b:]))

    pairs = [(a, b) for a in range(2, 21) for b in range(a + 2, 23)]
    assert tuple(found) == min(pairs, key=lambda p: cost(*p))
