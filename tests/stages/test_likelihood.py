"""The sums against the likelihood written down directly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from stages.likelihood import SUMS, add_sample, between, log_likelihood, peak, tame


def add(S: np.ndarray, e: np.ndarray, sigma: np.ndarray, doubt: np.ndarray, shapes: np.ndarray) -> None:
    add_sample(S, e, sigma, np.log(sigma), doubt, shapes, np.ones(e.shape[1]))


@pytest.mark.parametrize("sd", [(0.0, 0.0), (0.3, 0.0), (0.3, 0.7)])
def test_log_likelihood_is_that_of_the_marginal_normal(sd: tuple[float, float]) -> None:
    """e = c1 h1 + c2 h2 + noise with normal c: independent rows share their offsets."""
    rng = np.random.default_rng(0)
    n = 12
    sigma, shape = rng.uniform(0.1, 0.4, n), rng.uniform(0.2, 2.0, n)
    e = rng.normal(0, 0.2, n)
    S = np.zeros((1, 1, SUMS))
    for k in range(n):
        shapes = np.array([[1.0, shape[k]]])
        add_sample(
            S,
            e[k].reshape(1, 1),
            sigma[k].reshape(1, 1),
            np.log(sigma[k]).reshape(1, 1),
            np.zeros((1, 1)),
            shapes,
            np.ones(1),
        )
    H = np.column_stack([np.ones(n), shape])
    covariance = np.diag(sigma**2) + H @ np.diag(np.square(sd)) @ H.T
    expected = multivariate_normal(np.zeros(n), covariance).logpdf(e) + n / 2 * np.log(2 * np.pi)
    assert log_likelihood(S[0], np.array([sd])) == pytest.approx(expected)


def test_doubt_is_an_offset_of_its_own() -> None:
    S = np.zeros((1, 1, SUMS))
    for e in (0.5, 0.6, 0.4):
        add_sample(
            S,
            np.array([[e]]),
            np.array([[0.1]]),
            np.log([[0.1]]),
            np.array([[0.3]]),
            np.array([[1.0, 0.0]]),
            np.ones(1),
        )
    plain = S.copy()
    plain[..., 6] = 0.0
    assert log_likelihood(S[0], np.zeros((1, 2))) == pytest.approx(
        log_likelihood(plain[0], np.array([[0.3, 0.0]]))
    )


def test_missing_values_say_nothing() -> None:
    S = np.zeros((1, 2, SUMS))
    e = np.array([[3.0, np.nan]])
    add_sample(
        S, e, np.ones((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), np.array([[1.0, 0.0]] * 2), np.ones(2)
    )
    assert S[0, 0, 5] == 9.0
    assert (S[0, 1] == 0).all()


def test_spikes_are_held_near_the_remembered_mean() -> None:
    S = np.zeros((1, 2, SUMS))
    S[0, 0, [0, 3]] = 1e9, 5e9  # a mean of 5; of the other residual nothing is remembered
    e, sigma = np.array([[50.0, 50.0]]), np.array([[0.5, 0.5]])
    np.testing.assert_allclose(tame(e, sigma, S, 4.0, 1e9), [[7.0, 2.0]])
    np.testing.assert_allclose(tame(e, sigma, S, 4.0, 1.0), [[4.5, 2.0]])  # half of it a log's start
    np.testing.assert_allclose(tame(-e, sigma, S, 4.0, 1e9), [[-2.0, -2.0]])  # on the other side of zero
    np.testing.assert_allclose(tame(e / 50, sigma, S, 4.0, 1e9), e / 50)  # what is near zero is no spike


@given(st.floats(-0.9, 0.9), st.floats(0.05, 2.0))
def test_the_peak_of_a_parabola_is_exact(place: float, sd: float) -> None:
    x = np.linspace(-1, 1, 9)
    found = peak(x, 3.0 - 0.5 * ((x - place) / sd) ** 2)
    if abs(place) < 0.85:
        assert found == pytest.approx((place, 3.0, sd), abs=1e-9)


def test_a_peak_at_the_end_has_no_width() -> None:
    x = np.array([0.0, 1.0, 2.0])
    assert peak(x, np.array([1.0, 0.5, 0.0])) == (0.0, 1.0, np.inf)


def test_between_is_linear() -> None:
    x = np.array([[0.0, 10.0], [4.0, 30.0]])
    found = between(x, np.array([0, 0]), np.array([1, 1]), np.array([0.0, 0.25]))
    np.testing.assert_allclose(found, [[0.0, 10.0], [1.0, 15.0]])
