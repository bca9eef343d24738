"""Templates and decisions on changes with a known covariance, without any window."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from ingest.errors import RecipeError
from stages.deciding import Decision, probabilities
from stages.templates import Template

Array = NDArray[np.float64]
NAMES = ("tau", "k", "a1", "a2")
SLOW = Template(fault="slow", factors={"tau": "1 + m"}, indicators=NAMES)
PAIR = Template(fault="pair", factors={"k": "1 + m", "a2": "1 + 0.9 * m"}, indicators=NAMES)
ALONE = Template(fault="alone", factors={"a2": "1 + 0.9 * m"}, indicators=NAMES)
DECISION = Decision(templates=(SLOW, PAIR, ALONE), forgetting=0.3, change_sd=0.3, floor=0.0)


def covariance(seed: int = 0) -> Array:
    """Strongly correlated: the common mode of a1 and a2 is 30 times as uncertain as their ratio."""
    L = np.array([[0.05, 0, 0, 0], [0.01, 0.02, 0, 0], [0, 0, 0.03, 0], [0, 0, 0.03, 0.001]])
    turned = L @ np.diag(np.random.default_rng(seed).uniform(0.5, 2.0, 4))
    return np.asarray(turned @ turned.T, np.float64)


def test_curve_is_the_logarithm_of_the_factors() -> None:
    m = 0.25
    split = PAIR.split(np.array([0.0, np.log(1 + m), 0.0, np.log(1 + 0.9 * m)]), np.eye(4))
    assert np.expm1(split.eta) == pytest.approx(m, abs=1e-4)
    np.testing.assert_allclose(split.rest, 0.0, atol=1e-4)


@settings(max_examples=60, deadline=None)
@given(st.floats(-0.6, 2.0), st.integers(0, 1000))
def test_split_finds_the_nearest_point_and_the_rest_is_orthogonal(m: float, seed: int) -> None:
    P = covariance(seed)
    d = np.array([0.0, np.log(1 + m), 0.0, np.log(1 + 0.9 * m)])
    d = d + np.linalg.cholesky(P) @ np.random.default_rng(seed).normal(size=4)
    information = np.asarray(np.linalg.inv(P), np.float64)
    split = PAIR.split(d, information)
    # no other size on a fine grid leaves less
    etas = split.eta + np.linspace(-0.02, 0.02, 41)
    ms = np.expm1(etas)
    other = d - np.stack([0 * ms, np.log(1 + ms), 0 * ms, np.log(1 + 0.9 * ms)], axis=1)
    losses = np.einsum("gi,ij,gj->g", other, information, other)
    assert split.rest @ information @ split.rest <= losses.min() * (1 + 1e-3) + 1e-2
    slope = np.array([0.0, 1.0, 0.0, 0.9 * np.exp(split.eta) / (1 + 0.9 * np.expm1(split.eta))])
    np.testing.assert_allclose(split.information @ slope, 0.0, atol=1e-3 * np.abs(information).max())


def decide(changes: Array, P: Array, reference: Array | None = None) -> Array:
    belief = DECISION.start()
    for d in changes:
        belief = DECISION.add(belief, d, P)
    return DECISION.evidence(belief, np.zeros((4, 4)) if reference is None else reference)


def test_squares_without_a_change_are_chi_squared() -> None:
    """So the false-alarm rate is what the evidence says, also with a reference that is uncertain itself."""
    P, R = covariance(1), covariance(2) / 8
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(400):
        healthy = np.linalg.cholesky(R) @ rng.normal(size=4)
        belief = DECISION.start()
        for _ in range(12):
            belief = DECISION.add(belief, np.linalg.cholesky(P) @ rng.normal(size=4) - healthy, P)
        squares.append(belief.whole.squares(R))
    assert np.mean(squares) == pytest.approx(4.0, abs=0.5)
    assert np.mean(np.array(squares) > chi2.ppf(0.95, 4)) == pytest.approx(0.05, abs=0.03)


@pytest.mark.parametrize("growth", [0.0, 0.02])
@pytest.mark.parametrize(("index", "template"), list(enumerate(DECISION.templates)))
def test_a_fault_is_named_whether_it_grows_or_stands(index: int, template: Template, growth: float) -> None:
    """Although the windows tell very differently of different directions, a growing size is no other
    fault."""
    rng = np.random.default_rng(4)
    belief = DECISION.start()
    for t in range(25):
        P = covariance(t)
        eta = np.log1p(0.4 + growth * t)
        d = np.array([np.interp(eta, np.linspace(-2.3, 2.3, 461), c) for c in template.curve.T])
        belief = DECISION.add(belief, d + np.linalg.cholesky(P) @ rng.normal(size=4), P)
    evidence = DECISION.evidence(belief, np.zeros((4, 4)))
    assert int(np.argmax(evidence)) == index
    assert probabilities(evidence)[index] > 0.99
    size = np.expm1(belief.trends[index].ahead(0.0)[0])
    assert size == pytest.approx(0.4 + growth * 24, abs=0.12)


def test_what_no_template_explains_is_unknown() -> None:
    rng = np.random.default_rng(5)
    P = covariance()
    both = np.array([0.4, -0.3, 0.0, 0.0])  # slow, and k without a2
    changes = both + rng.normal(size=(20, 4)) @ np.linalg.cholesky(P).T
    evidence = decide(changes, P)
    assert int(np.argmax(evidence)) == 3
    nothing = decide(rng.normal(size=(20, 4)) @ np.linalg.cholesky(P).T, P)
    assert nothing.max() < 3.0
    assert nothing[3] < nothing[:3].min()  # freedom has its price


def test_probabilities_are_the_softmax() -> None:
    np.testing.assert_allclose(probabilities(np.array([1000.0, 1000.0 + np.log(3.0)])), [0.25, 0.75])


@pytest.mark.parametrize(
    ("factors", "word"),
    [
        ({"tu": "1 + m"}, "did you mean tau"),
        ({"tau": "2 + m"}, "1 for m = 0"),
        ({"tau": "1 + x"}, "depends on m"),
        ({}, "no indicator"),
    ],
)
def test_wrong_templates_are_told(factors: dict[str, str], word: str) -> None:
    with pytest.raises(RecipeError, match=word):
        Template(fault="f", factors=factors, indicators=NAMES)
