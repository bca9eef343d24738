"""The sums against the likelihood written down directly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from stages.hypotheses import Hypothesis
from stages.likelihood import (
    A11,
    B1,
    SUMS,
    D,
    Q,
    add_sample,
    fade,
    informed,
    log_likelihoods,
    offsets_known,
    peak,
    tame,
)
from stages.size_grid import Grid, refined_grid

AS_IT_IS = refined_grid([Hypothesis(undo={"y": "theta"}, sizes=(1.0,), from_zero=False)], [(1.0,)], 0, 1)


def add(
    S: np.ndarray,
    e: list[list[float]],
    *,
    sigma: float = 1.0,
    doubt: float = 0.0,
    shape: float = 0.0,
    grid: Grid = AS_IT_IS,
    clip: float = np.inf,
    short: np.ndarray | None = None,
    seen: float = 0.0,
) -> None:
    """Add a row of residuals (residuals, computed points), all of one spread."""
    x = np.array(e)
    like = np.full(x.shape, sigma)
    row = (x, like, np.log(like), np.full(x.shape, doubt))
    shapes = np.tile([1.0, shape], (len(x), 1))
    add_sample(
        S, row, grid, shapes, np.ones(len(x)), np.zeros_like(S) if short is None else short, seen, clip
    )


@pytest.mark.parametrize("sd", [(0.0, 0.0), (0.3, 0.0), (0.3, 0.7)])
def test_log_likelihood_is_that_of_the_marginal_normal(sd: tuple[float, float]) -> None:
    """e = c1 h1 + c2 h2 + noise with normal c: independent rows share their offsets."""
    rng = np.random.default_rng(0)
    n = 12
    sigma, shape = rng.uniform(0.1, 0.4, n), rng.uniform(0.2, 2.0, n)
    e = rng.normal(0, 0.2, n)
    S = np.zeros((1, SUMS, 3))
    for k in range(n):
        add(S, [[e[k], 9.0]], sigma=sigma[k], shape=shape[k])
    H = np.column_stack([np.ones(n), shape])
    covariance = np.diag(sigma**2) + H @ np.diag(np.square(sd)) @ H.T
    expected = multivariate_normal(np.zeros(n), covariance).logpdf(e) + n / 2 * np.log(2 * np.pi)
    L = log_likelihoods(S, np.array([sd]), np.array([sd]))
    assert L[[0, 2]] == pytest.approx(expected)  # the log as it is, and `unknown` with the same offsets
    assert L[1] < expected


def test_two_residuals_are_independent() -> None:
    S = np.zeros((2, SUMS, 3))
    add(S, [[0.3, 0.0], [-0.8, 0.0]], sigma=0.5)
    sd = np.array([[0.2, 0.0], [0.1, 0.0]])
    apart = sum(log_likelihoods(S[r : r + 1], sd[r : r + 1], sd[r : r + 1])[0] for r in (0, 1))
    assert log_likelihoods(S, sd, sd)[0] == pytest.approx(apart)


def test_doubt_is_an_offset_of_its_own() -> None:
    S = np.zeros((1, SUMS, 3))
    for e in (0.5, 0.6, 0.4):
        add(S, [[e, 0.0]], sigma=0.1, doubt=0.3)
    plain = S.copy()
    plain[:, D] = 0.0
    none, some = np.zeros((1, 2)), np.array([[0.3, 0.0]])
    assert log_likelihoods(S, none, none)[0] == pytest.approx(log_likelihoods(plain, some, some)[0])


def test_missing_values_say_nothing() -> None:
    S = np.zeros((2, SUMS, 3))
    add(S, [[3.0, 3.0], [np.nan, np.nan]])
    assert S[0, Q, 0] == 9.0
    assert (S[1] == 0).all()
    add(S, [[3.0, 3.0], [np.nan, 3.0]])  # nor does a hypothesis where the log as it is says nothing
    assert (S[1] == 0).all()
    add(S, [[3.0, np.nan], [3.0, 3.0]])
    assert S[0, Q].tolist() == [27.0, 18.0, 27.0]


def test_spikes_are_held_near_the_remembered_mean() -> None:
    def held(x: float, seen: float) -> float:
        return tame(x, 2.0, 5.0 * seen / (seen + 1.0))

    assert held(50.0, 1e9) == pytest.approx(7.0)
    assert held(50.0, 1.0) == pytest.approx(4.5)  # half of it a log's start
    assert held(-50.0, 1e9) == -2.0  # on the other side of zero
    assert held(1.0, 1e9) == 1.0  # what is near zero is no spike
    short = np.zeros((1, SUMS, 3))
    short[0, A11], short[0, B1] = 1e9, 5e9
    S = np.zeros((1, SUMS, 3))
    add(S, [[50.0, 50.0]], sigma=0.5, clip=4.0, short=short, seen=1e9)
    np.testing.assert_allclose(S[0, B1], np.array([7.0, 7.0, 50.0]) / 0.25)  # `unknown` sees it as it is


def test_sums_fade() -> None:
    S, fresh = np.ones((1, SUMS, 3)), np.full((1, SUMS, 3), 2.0)
    fade(S, 0.5, fresh, np.ones((1, 2)))
    assert (S == 2.5).all()


def test_between_two_sizes_all_is_linear() -> None:
    grid = refined_grid([Hypothesis(undo={"y": "y - theta"}, sizes=(1.0,))], [(1.0,)], 0, 4)
    S = np.zeros((1, SUMS, len(grid.left) + 1))
    add(S, [[0.0, 4.0]], grid=grid)
    place = dict(zip(grid.sizes[0], grid.points[0], strict=True))
    for size in (0.0, 0.25, 0.5, 1.0):
        assert S[0, B1, place[size]] == pytest.approx(4 * size)


@given(st.floats(-0.9, 0.9), st.floats(0.05, 2.0))
def test_the_peak_of_a_parabola_is_exact(place: float, sd: float) -> None:
    x = np.linspace(-1, 1, 9)
    found = peak(x, 3.0 - 0.5 * ((x - place) / sd) ** 2)
    if abs(place) < 0.85:
        assert found == pytest.approx((place, 3.0, sd), abs=1e-9)


def test_a_peak_at_the_end_has_no_width() -> None:
    x = np.array([0.0, 1.0, 2.0])
    assert peak(x, np.array([1.0, 0.5, 0.0])) == (0.0, 1.0, np.inf)


@pytest.mark.parametrize("wander", [1e-9, 0.2])
def test_an_offset_known_from_before_is_taken_off(wander: float) -> None:
    """Twelve samples before, as they are, and five since under a fault, against the normal distribution of
    the five given the twelve. The twelve tell the offset to 0.06; where it wanders they count for less."""
    rng, sd, sigma = np.random.default_rng(1), 0.5, 0.2
    before, since = rng.normal(0.4, sigma, 12), rng.normal(0.4, sigma, 5)
    whole, recent = np.zeros((1, SUMS, 3)), np.zeros((1, SUMS, 3))
    for e in before:
        add(whole, [[e, e - 0.3]], sigma=sigma)
    for e in since:
        add(whole, [[e, e - 0.3]], sigma=sigma)
        add(recent, [[e, e - 0.3]], sigma=sigma)
    prior = np.array([0.0, -np.inf, -np.inf])  # of being healthy, the fault, and the log as it is
    sds = np.array([[sd, 0.0]])
    L = log_likelihoods(informed(recent, whole, recent, np.array([wander]), prior, sds), sds, sds)

    share = min(1.0, sigma**2 / (12 * wander**2))  # of the twelve samples' information
    C = sigma**2 * np.diag([*np.full(12, 1 / share), *np.ones(5)]) + sd**2
    given = C[12:, :12] @ np.linalg.inv(C[:12, :12])
    normal = multivariate_normal(np.zeros(5), C[12:, 12:] - given @ C[:12, 12:])
    healthy, faulty = (normal.logpdf(since - x - given @ before) for x in (0.0, 0.3))
    assert L[1] - L[0] == pytest.approx(faulty - healthy, rel=1e-6)


def test_offsets_are_known_once_the_log_says_as_much_as_is_supposed() -> None:
    whole, recent = np.zeros((1, SUMS, 3)), np.zeros((1, SUMS, 3))
    known = []
    for _ in range(6):
        known.append(offsets_known(recent, whole, np.array([[0.5, 0.0]]), np.array([0.1])))
        add(whole, [[0.0, 0.0]])
    assert known == [False] * 4 + [True] * 2
    assert not offsets_known(recent, whole, np.array([[0.5, 0.0]]), np.array([np.inf]))
    assert not offsets_known(whole, whole, np.array([[0.5, 0.0]]), np.array([0.1]))
