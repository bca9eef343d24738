"""Sums of many samples at once against those of one after the other."""

from __future__ import annotations

import numpy as np

from stages.hypotheses import Hypothesis
from stages.likelihood import A11, B1, SUMS, add_sample
from stages.pooled import Blend, as_computed, pooled
from stages.size_grid import Grid, refined_grid

GRID = refined_grid([Hypothesis(undo={"y": "theta"}, sizes=(1.0, 2.0))], [(1.0, 2.0)], 0, 3)
N, R = 40, 2


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
    S = pooled((e, sigma, ln_sigma, doubt), Blend(*GRID[:3]), shapes, weight, np.inf)
    np.testing.assert_allclose(S, one_by_one(row, GRID, shapes, weight), rtol=1e-12, atol=1e-12)
    plain = pooled((e, sigma, ln_sigma, doubt), as_computed(3), shapes, weight, np.inf)
    np.testing.assert_array_equal(plain[:, :, 0], S[:, :, 0])


def test_a_spike_is_held_near_the_mean_of_all_samples() -> None:
    e, one = np.full((N, 1, 1), 2.0), np.ones((N, 1, 1))
    e[7] = 50.0
    S = pooled((e, one, 0 * one, 0 * one), as_computed(1), np.ones((N, 1, 2)), np.ones((N, 1)), 4.0)
    mean = e.mean()
    assert S[0, A11, 0] == N
    np.testing.assert_allclose(S[0, B1, 0], 2.0 * (N - 1) + mean + 4.0)
