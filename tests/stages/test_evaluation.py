"""The compiled pass against the formulas written down in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from stages.evaluation import Evaluation, evaluate
from stages.partition import Partition

rng = np.random.default_rng(0)
M, D, B = 7, 3, 5
NODES, THETA = rng.uniform(0, 1, (M, D)), rng.normal(size=(M, D + 1))
ROOT, MEAN = rng.normal(size=(M * (D + 1), B)), rng.uniform(0, 1, (M, D))
WHITEN = rng.normal(size=(M, D, D))
S = rng.uniform(-1, 2, (400, D))


def at(S: np.ndarray, width: float) -> Evaluation:
    return Evaluation(*evaluate(S, NODES, width, np.vstack([ROOT.T, THETA.ravel()]), MEAN, WHITEN, 1.7))


@pytest.mark.parametrize("width", [0.0, 0.05, 0.4])
def test_it_says_what_the_formulas_say(width: float) -> None:
    found, unit = at(S, width), Partition(NODES, np.empty((0, 2), dtype=np.int64)).assign(S)
    X = np.column_stack([np.ones(len(S)), S])
    square = cdist(S, NODES, "sqeuclidean")
    nu = np.eye(M)[unit]
    if width:
        nu = np.exp((square.min(axis=1, keepdims=True) - square) / (2 * width**2))
        nu /= nu.sum(axis=1, keepdims=True)
    phi = nu[:, :, None] * X[:, None, :]
    np.testing.assert_array_equal(found.unit, unit)
    np.testing.assert_allclose(found.prediction, (phi * THETA).sum(axis=(1, 2)), atol=1e-12)
    off = phi.reshape(len(S), -1) @ ROOT
    np.testing.assert_allclose(found.doubt, np.sqrt((off**2).sum(axis=1)), atol=1e-12)
    away = np.einsum("nij,nj->ni", WHITEN[unit], S - MEAN[unit])
    np.testing.assert_allclose(found.novelty, np.sqrt((away**2).sum(axis=1)) / 1.7, rtol=1e-12)


def test_far_away_the_nearest_region_decides() -> None:
    found = at(np.full((1, D), 100.0), 0.1)
    m = found.unit[0]
    assert found.prediction[0] == pytest.approx(THETA[m, 0] + THETA[m, 1:].sum() * 100, rel=1e-6)


def test_a_missing_regressor_gives_nothing() -> None:
    holes = S.copy()
    holes[1::2, 2] = np.nan
    found, whole = at(holes, 0.1), at(S, 0.1)
    for k in range(4):
        np.testing.assert_array_equal(found[k][::2], whole[k][::2])
    assert (found.unit[1::2] == -1).all()
    assert all(np.isnan(x[1::2]).all() for x in found[:3])
