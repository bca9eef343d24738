"""Trends of quantities at rest and on the move."""

from __future__ import annotations

import numpy as np
import pytest

from stages.trend import Trend


def test_error_at_rest_is_that_of_many_runs() -> None:
    rng = np.random.default_rng(1)
    states, last = [], None
    for _ in range(2000):
        trend = Trend.at(rng.normal(scale=0.02), 0.02**2)
        for _ in range(30):
            trend = trend.follow(rng.normal(scale=0.02), 0.02**2)
        states.append(trend.state)
        last = trend
    assert last is not None
    np.testing.assert_allclose(np.cov(np.array(states).T), last.still, rtol=0.1)
    assert (np.diag(last.still) < np.diag(last.covariance)).all()


def test_a_ramp_is_followed_within_what_it_claims() -> None:
    rng = np.random.default_rng(2)
    trend, off = Trend.at(0.0, 1e-4), []
    for t in range(1, 400):
        trend = trend.follow(0.01 * t + rng.normal(scale=0.01), 1e-4)
        level, sd = trend.ahead(2.0)
        off.append((level - 0.01 * (t + 2)) / sd)
    assert np.std(off[50:]) < 1.2
    assert trend.slope[0] == pytest.approx(0.01, abs=3 * np.sqrt(trend.slope[1]))
