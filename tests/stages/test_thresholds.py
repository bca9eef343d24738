"""The threshold against its probability, drawn from what it supposes."""

from __future__ import annotations

import numpy as np
import pytest

from stages.thresholds import SUPPOSED, exceeded, thresholds


@pytest.mark.parametrize("logs", [1, 3, 7])
def test_another_healthy_log_exceeds_it_as_often_as_said(logs: int) -> None:
    """Means with the distribution that is supposed, logs with each, and one log more."""
    rng, risk, after_one, draws = np.random.default_rng(0), 0.05, 12.0, 200_000
    in_all = after_one / (risk ** (-1 / (SUPPOSED + 1)) - 1)
    mean = 1 / rng.gamma(SUPPOSED, 1 / in_all, draws)
    threshold = exceeded(rng.exponential(mean, (logs, draws)), risk, after_one)
    assert np.mean(rng.exponential(mean) > threshold) == pytest.approx(risk, rel=0.03)


def test_quiet_logs_lower_it_and_loud_ones_raise_it() -> None:
    quiet = [float(exceeded(np.zeros((n, 1)), 0.003, 12.0)[0]) for n in (1, 2, 5, 20)]
    assert quiet[0] == pytest.approx(12.0)
    assert quiet == sorted(quiet, reverse=True)
    assert exceeded(np.full((5, 1), 8.0), 0.003, 12.0)[0] > 20


def test_each_kind_has_its_least_and_a_margin() -> None:
    largest = np.zeros((6, 3, 2))
    largest[2, 0, 1], largest[4, 2, 0] = 20.0, 6.0
    found = thresholds(largest, np.array([12.0, 8.0]), 3.0, 0.003)
    assert found[:2].tolist() == [[12.0, 23.0], [8.0, 8.0]]
    assert found[2, 0] >= 9.0
    assert found[2, 1] == pytest.approx(exceeded(largest[:, 2], 0.003, 12.0)[1])
