from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from stages.blended import SHRINKAGE, fit_blended, fit_centres, metric
from stages.tree import nested_centres

Array = NDArray[np.float64]


def made(N: int = 600, noise: float = 0.05) -> tuple[Array, Array]:
    """Curved in the first regressor, linear in the second, blind to the third."""
    rng = np.random.default_rng(2)
    X = rng.uniform(-1.7, 1.7, size=(N, 3))
    y = np.sin(2.5 * X[:, 0]) + 0.5 * X[:, 1] + noise * rng.normal(size=N)
    return X, (y - y.mean()) / y.std()


def test_the_score_is_the_log_evidence() -> None:
    """S against the marginal likelihood of y ~ N(0, s^2 (I + F Lambda^-1 F')), at the best s^2."""
    X, y = made(200)
    centres = nested_centres(X, 3)[3]

    def evidence(shrinkage: float) -> float:
        model = fit_centres(X, y, centres, np.eye(3))
        F = model.features(X)
        prior = np.r_[np.ones(4), np.full(F.shape[1] - 4, shrinkage)]
        C = np.eye(200) + (F / prior) @ F.T
        variance = y @ np.linalg.solve(C, y) / 200
        return float(-2 * multivariate_normal(cov=variance * C, allow_singular=True).logpdf(y))

    model = fit_centres(X, y, centres, np.eye(3))
    constant = 200 * (1 + np.log(2 * np.pi))
    assert model.S + constant == pytest.approx(evidence(model.shrinkage), abs=1e-6)
    assert evidence(model.shrinkage) == min(evidence(shrinkage) for shrinkage in SHRINKAGE)


def test_weights_are_repetitions() -> None:
    X, y = made(200)
    centres, T = nested_centres(X, 2)[2], np.eye(3)
    twice = np.r_[0:200, 0:100]
    weight = np.r_[np.full(100, 2.0), np.ones(100)]
    one = fit_centres(X[twice], y[twice], centres, T)
    two = fit_centres(X, y, centres, T, weight=weight)
    assert pytest.approx(one.S) == two.S
    np.testing.assert_allclose(two.theta, one.theta, atol=1e-8)


def test_gradient_is_the_derivative() -> None:
    X, y = made()
    model = fit_blended(X, y)
    assert model.M > 1
    for j in range(3):
        step = np.eye(3)[j] * 1e-5
        slope = (model.predict(X + step) - model.predict(X - step)) / 2e-5
        np.testing.assert_allclose(model.gradient(X)[:, j], slope, atol=1e-6)


def test_the_metric_finds_where_the_function_is_curved() -> None:
    X, y = made(2000)
    share = np.diag(metric(fit_blended(X, y, passes=0), X))
    assert share[0] > 0.9
    assert share[1:].max() < 0.5
    assert fit_blended(X, y).S < fit_blended(X, y, passes=0).S - 50


def test_it_predicts_to_the_noise() -> None:
    X, y = made(2000)
    model = fit_blended(X[:1000], y[:1000])
    noise = 0.05 / np.sqrt(np.var(np.sin(2.5 * X[:, 0]) + 0.5 * X[:, 1]))
    assert np.sqrt(np.mean((y - model.predict(X))[1000:] ** 2)) < 1.03 * noise


def test_a_linear_function_stays_linear() -> None:
    rng = np.random.default_rng(0)
    X, b = rng.normal(size=(500, 3)), np.array([1.0, -0.5, 0.2])
    model = fit_blended(X, X @ b + 0.1 * rng.normal(size=500))
    assert model.M <= 2
    np.testing.assert_allclose(model.gradient(X), np.broadcast_to(b, X.shape), atol=0.05)
