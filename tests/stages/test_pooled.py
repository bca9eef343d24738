"""Sums of many samples at once against those of one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from stages.hypotheses import Hypothesis
from stages.likelihood import A11, B1, SUMS, add_sample, log_likelihoods
from stages.pooled import Blend, as_computed, pooled
from stages.size_grid import Grid, refined_grid

GRID = refined_grid([Hypothesis(undo={"y": "theta"}, sizes=(1.0, 2.0))], [(1.0, 2.0)], 0, 3)
N, R = 40, 2
ALL = np.array([0, N])


def made_up() -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.1, 0.4, (N, R, 3))
    e, doubt = rng.normal(size=(N, R, 3)), rng.uniform(0, 0.2, (N, R, 3))
    e[5, 1, 2] = np.nan  # where a hypothesis says nothing
    return (e, sigma, np.log(sigma), doubt), rng.normal(1, 0.2, (N, R, 2)), rng.uniform(0.1, 1, (N, R))


def one_by_one(row: tuple[np.ndarray, ...], grid: Grid, shapes: np.ndarray, weight: np.ndarray) -> np.ndarray:
    S = np.zeros((R, SUMS, len(grid.left) + 1))
    for n in range(N):
        e, sigma, ln_sigma, doubt = (x[n] for x in row)
        add_sample(S, (e, sigma, ln_sigma, doubt), grid, shapes[n], weight[n], np.zeros_like(S), 0.0, np.inf)
    return S[:, :, :-1]


def test_they_are_those_of_one_sample_after_the_other() -> None:
    row, shapes, weight = made_up()
    e, sigma, ln_sigma, doubt = row
    shared = (e, sigma, ln_sigma, np.zeros_like(e), doubt)
    S = pooled(shared, Blend(*GRID[:3]), shapes, weight, np.inf, ALL)
    np.testing.assert_allclose(S, one_by_one(row, GRID, shapes, weight), rtol=1e-12, atol=1e-12)
    plain = pooled(shared, as_computed(3), shapes, weight, np.inf, ALL)
    np.testing.assert_array_equal(plain[:, :, 0], S[:, :, 0])


def test_a_spike_is_held_near_the_mean_of_all_samples() -> None:
    e, one = np.full((N, 1, 1), 2.0), np.ones((N, 1, 1))
    e[7] = 50.0
    row = (e, one, 0 * one, 0 * one, 0 * one)
    S = pooled(row, as_computed(1), np.ones((N, 1, 2)), np.ones((N, 1)), 4.0, ALL)
    mean = e.mean()
    assert S[0, A11, 0] == N
    np.testing.assert_allclose(S[0, B1, 0], 2.0 * (N - 1) + mean + 4.0)


def test_what_a_group_shares_is_integrated_out() -> None:
    """Against the multivariate normal whose covariance has it."""
    rng = np.random.default_rng(5)
    starts, sd = np.array([0, 12, 25, N]), np.array([[0.3, 0.2]])
    group = np.repeat(np.arange(3), np.diff(starts))
    sigma, h = rng.uniform(0.5, 2.0, (N, 1, 1)), rng.normal(1, 0.3, (N, 1, 2))
    e, doubt = rng.normal(size=(N, 1, 1)), np.full((N, 1, 1), 0.7)
    wrong = np.full((N, 1, 1), 0.4)
    row = (e, sigma, np.log(sigma), doubt, wrong)
    S = pooled(row, as_computed(1), h, np.ones((N, 1)), np.inf, starts)
    h1, h2 = h[:, 0, 0], h[:, 0, 1]
    cov = np.diag(sigma.ravel() ** 2) + (0.3**2 + 0.4**2) * np.outer(h1, h1) + 0.2**2 * np.outer(h2, h2)
    cov += 0.7**2 * np.outer(h1, h1) * (group[:, None] == group)
    expected = multivariate_normal(np.zeros(N), cov).logpdf(e.ravel()) + 0.5 * N * np.log(2 * np.pi)
    S = np.concatenate([S, S], axis=2)  # the last point is that of `unknown`
    assert log_likelihoods(S, sd, sd)[0] == pytest.approx(expected, rel=1e-9)
