from __future__ import annotations

import numpy as np
import pytest

from ingest.errors import LogError
from stages.gsmms import INSIDE, Combination, Gsmms, fit_gsmms
from stages.partition import Growth

COMBINATIONS: tuple[Combination, ...] = ("hard", "blended")


def sample(n: int, seed: int, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    S = rng.uniform(size=(n, 2))
    return S, np.sin(5 * S[:, 0]) + S[:, 0] * S[:, 1] ** 2 + noise * rng.normal(size=n)


def rms(e: np.ndarray) -> float:
    return float(np.sqrt(np.mean(e**2)))


@pytest.mark.parametrize("combination", ["hard", "blended"])
def test_one_region_is_weighted_least_squares(combination: str) -> None:
    S, y = sample(300, 0)
    weight = np.random.default_rng(1).uniform(0.1, 1, 300)
    model = fit_gsmms(S, y, weight, growth=Growth(nodes=1), combination=combination)  # type: ignore[arg-type]
    X, root = np.column_stack([np.ones(300), S]), np.sqrt(weight)
    expected = np.linalg.lstsq(X * root[:, None], y * root, rcond=None)[0]
    np.testing.assert_allclose(model.theta[0], expected, atol=1e-9)


def test_hard_regions_without_neighbours_are_least_squares_each() -> None:
    S, y = sample(3000, 0)
    model = fit_gsmms(S, y, growth=Growth(nodes=6), combination="hard", neighbourhood=1e-3)
    unit = model.partition.assign(S)
    for m in range(6):
        X = np.column_stack([np.ones((unit == m).sum()), S[unit == m]])
        expected = np.linalg.lstsq(X, y[unit == m], rcond=None)[0]
        np.testing.assert_allclose(model.theta[m], expected, atol=1e-8)
    X = np.column_stack([np.ones(len(S)), S])
    np.testing.assert_allclose(model.predict(S), (X * model.theta[unit]).sum(axis=1), atol=1e-12)


def test_the_neighbourhood_weighs_all_samples() -> None:
    """(5.48)-(5.50) with the sum over all samples, solved directly on the rows."""
    S, y = sample(2000, 3)
    model = fit_gsmms(S, y, growth=Growth(nodes=5), combination="hard", neighbourhood=0.8)
    unit, apart = model.partition.assign(S), model.partition.distances()
    X = np.column_stack([np.ones(len(S)), S])
    for m in range(5):
        root = np.sqrt(np.exp(-(apart[m, unit] ** 2) / (2 * 0.8**2)))
        expected = np.linalg.lstsq(X * root[:, None], y * root, rcond=None)[0]
        np.testing.assert_allclose(model.theta[m], expected, atol=1e-7)


def test_an_affine_system_is_found_exactly_and_extrapolated() -> None:
    S = np.random.default_rng(0).uniform(size=(400, 2))
    y = 3 + S @ np.array([1.0, -2.0])
    model = fit_gsmms(S, y, growth=Growth(nodes=8))
    far = np.array([[2.0, 2.0], [-1.0, 0.5]])
    np.testing.assert_allclose(model.predict(far), 3 + far @ np.array([1.0, -2.0]), atol=1e-6)


def test_blending_beats_hard_regions_and_both_beat_one_plane() -> None:
    (S, y), (fresh, truth) = sample(4000, 0), sample(4000, 1, noise=0.0)
    error = {
        c: rms(fit_gsmms(S, y, growth=Growth(nodes=12), combination=c).predict(fresh) - truth)
        for c in COMBINATIONS
    }
    plane = rms(fit_gsmms(S, y, growth=Growth(nodes=1)).predict(fresh) - truth)
    assert error["blended"] < 0.5 * error["hard"] < 0.25 * plane
    assert error["blended"] < 0.015


@pytest.mark.parametrize("combination", ["hard", "blended"])
def test_doubt_is_the_deviation_over_repeated_noise(combination: str) -> None:
    """A model of fixed regions and width, fitted to fresh noise many times."""
    rng = np.random.default_rng(5)
    S, _ = sample(400, 0)
    query = np.array([[0.5, 0.5], [1.5, -0.5]])
    models = [
        fit_gsmms(S, rng.normal(size=400), growth=Growth(nodes=1), combination=combination)  # type: ignore[arg-type]
        for _ in range(200)
    ]
    found = [m.evaluate(query) for m in models]
    spread = np.std([f.prediction for f in found], axis=0)
    doubt = np.sqrt(np.mean([f.doubt**2 for f in found], axis=0))
    np.testing.assert_allclose(doubt, spread, rtol=0.12)


def test_what_rests_on_one_visit_is_doubted() -> None:
    """Samples that all say the same are no more certain for being many, where they are of one block."""
    rng = np.random.default_rng(6)
    S = rng.uniform(0, 0.6, (2000, 1))
    S[1000:1100] = rng.uniform(0.8, 1.0, (100, 1))
    y = S[:, 0] + rng.normal(0, 0.01, 2000)
    y[1000:1100] += 0.3
    model = fit_gsmms(S, y, growth=Growth(nodes=8))
    often, once = model.evaluate(np.array([[0.3], [0.9]])).doubt
    assert once > 0.1 > 0.01 > often


def test_doubt_and_novelty_grow_away_from_the_training_data() -> None:
    S, y = sample(2000, 0)
    model = fit_gsmms(S, y, growth=Growth(nodes=10))
    line = np.column_stack([np.linspace(1.0, 3.0, 20), np.full(20, 0.5)])
    beyond = model.evaluate(line)
    assert (np.diff(beyond.novelty) > 0).all()
    assert beyond.doubt[-1] > 4 * beyond.doubt[0]
    assert (model.evaluate(S).novelty <= 1).mean() == pytest.approx(INSIDE, abs=2e-3)


def test_few_outliers_of_one_region_do_not_widen_the_domain_of_the_others() -> None:
    """Three samples in a thousand, far from a tight cluster at the origin."""
    rng = np.random.default_rng(0)
    S = np.vstack([rng.normal(0.0, 0.01, (500, 2)), rng.uniform(0.5, 1.0, (1500, 2))])
    odd = S.copy()
    odd[:6] += [0.3, -0.3]
    tidy, odd_one = (fit_gsmms(s, s.sum(axis=1), growth=Growth(nodes=6)) for s in (S, odd))
    assert odd_one.reach < 1.5 * tidy.reach


@pytest.mark.parametrize("combination", ["hard", "blended"])
def test_arrays_round_trip_and_missing_regressors(combination: str) -> None:
    S, y = sample(500, 0)
    model = fit_gsmms(S, y, growth=Growth(nodes=4), combination=combination)  # type: ignore[arg-type]
    again = Gsmms.from_arrays(model.to_arrays())  # type: ignore[arg-type]
    S[3, 1] = np.nan
    np.testing.assert_array_equal(model.predict(S), again.predict(S))
    assert np.isnan(again.predict(S)).nonzero()[0].tolist() == [3]


def test_too_few_samples() -> None:
    with pytest.raises(LogError, match=r"5 complete samples are too few.*at least 9"):
        fit_gsmms(np.random.default_rng(0).uniform(size=(5, 2)), np.zeros(5))
