"""Subspace identification against exact systems, the covariance it claims, and SLICOT."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ingest.errors import LogError
from stages.statespace import StateSpace
from stages.subspace import METHODS, Method, identify, lag_gram, order_criterion

Array = NDArray[np.float64]

SYSTEM = StateSpace(
    A=np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.5]]),
    B=np.array([[1.0, 0.0], [0.0, 0.5], [0.5, 1.0]]),
    C=np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]]),
    D=np.array([[0.0, 0.2], [0.0, 0.0]]),
    K=np.array([[0.3, 0.1], [0.0, 0.2], [0.1, -0.1]]),
    R=np.diag([0.09, 0.04]),
    dt=0.1,
)


def data(N: int, noise: float, seed: int = 0) -> tuple[Array, Array]:
    """Outputs (N, 2) and inputs (N, 2) of SYSTEM in innovations form."""
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=(N, 2)), noise * rng.normal(size=(N, 2)) * np.sqrt(np.diag(SYSTEM.R))
    driven = StateSpace(
        A=SYSTEM.A, B=np.hstack([SYSTEM.B, SYSTEM.K]), C=SYSTEM.C, D=np.hstack([SYSTEM.D, np.eye(2)]),
        K=SYSTEM.K, R=SYSTEM.R, dt=SYSTEM.dt,
    )  # fmt: skip
    return driven.simulate(np.hstack([u, e])), u


def markov(model: StateSpace, B: Array) -> Array:
    """The impulse response, which does not depend on the choice of states."""
    return np.array([model.C @ np.linalg.matrix_power(model.A, k) @ B for k in range(12)])


@pytest.mark.parametrize("method", METHODS)
def test_exact_without_noise(method: Method) -> None:
    """To half the digits, as Gram matrices are squares."""
    y, u = data(1500, 0.0)
    found = identify(lag_gram(y, u, 8), SYSTEM.dt, method=method)
    assert found.order == 3
    np.testing.assert_allclose(found.model.poles, SYSTEM.poles, atol=1e-6)
    np.testing.assert_allclose(markov(found.model, found.model.B), markov(SYSTEM, SYSTEM.B), atol=1e-5)
    np.testing.assert_allclose(found.model.D, SYSTEM.D, atol=1e-5)
    np.testing.assert_allclose(found.model.gains, SYSTEM.gains, atol=1e-4)
    np.testing.assert_allclose(found.model.R, 0.0, atol=1e-10)


@pytest.mark.parametrize("method", METHODS)
def test_consistent_with_noise(method: Method) -> None:
    """Errors fall as 1 / sqrt(N); K and R are those of the innovations form, without a Riccati equation."""
    y, u = data(40_000, 1.0)
    found = identify(lag_gram(y, u, 15), SYSTEM.dt, method=method)
    assert found.order == 3
    np.testing.assert_allclose(found.model.poles, SYSTEM.poles, rtol=0.01)
    np.testing.assert_allclose(markov(found.model, found.model.B), markov(SYSTEM, SYSTEM.B), atol=0.03)
    np.testing.assert_allclose(markov(found.model, found.model.K), markov(SYSTEM, SYSTEM.K), atol=0.03)
    np.testing.assert_allclose(found.model.R, SYSTEM.R, atol=0.004)


def test_predictions_leave_innovations() -> None:
    y, u = data(40_000, 1.0)
    model = identify(lag_gram(y, u, 15), SYSTEM.dt, order=3).model
    e = (y - model.predict(y, u))[100:]
    np.testing.assert_allclose(e.T @ e / len(e), SYSTEM.R, atol=0.003)
    assert abs(np.corrcoef(e[1:, 0], e[:-1, 0])[0, 1]) < 0.02


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 9), st.integers(1, 2), st.integers(1, 2))
def test_gram_is_that_of_the_hankel_matrix_and_adds_up(seed: int, r: int, outputs: int, inputs: int) -> None:
    rng = np.random.default_rng(seed)
    N, split = int(rng.integers(8 * r, 12 * r + 40)), 4 * r
    y, u = rng.normal(size=(N, outputs)) + 1.0, rng.normal(size=(N, inputs))
    z = np.hstack([y, u])
    hankel = np.array([z[t : t + 2 * r].reshape(-1) for t in range(N - 2 * r + 1)])
    whole = lag_gram(y, u, r)
    np.testing.assert_allclose(whole.gram, hankel.T @ hankel, rtol=1e-9, atol=1e-9)
    overlap = split + 2 * r - 1
    both = lag_gram(y[:overlap], u[:overlap], r) + lag_gram(y[split:], u[split:], r)
    np.testing.assert_allclose(both.gram, whole.gram, rtol=1e-9, atol=1e-9)
    assert both.count == whole.count


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_same_poles_as_slicot(noise: float) -> None:
    """MOESP of one output from the same lags, IB01AD and IB01BD; of several outputs, we scale each."""
    slicot = pytest.importorskip("ctrlsys", reason="SLICOT (ctrlsys) is not installed")
    y, u = data(3000, noise)
    y, r, n = y[:, :1], 10, 3
    *_, factor, _, _, info = slicot.ib01ad(
        "M",
        "C" if noise else "Q",
        "N",
        "O",
        "N",
        "N",
        r,
        2,
        1,
        np.asfortranarray(u),
        np.asfortranarray(y),
        0.0,
        -1.0,
    )
    assert info == 0
    A, C, B, D, *_, info = slicot.ib01bd("C", "A", "N", r, n, 2, 1, len(u), factor, 0.0)
    assert info == 0
    ours = identify(lag_gram(y, u, r), SYSTEM.dt, order=n, method="moesp").model
    theirs = StateSpace(A=A, B=B, C=C, D=D, K=SYSTEM.K, R=SYSTEM.R, dt=SYSTEM.dt)
    np.testing.assert_allclose(ours.poles, theirs.poles, rtol=1e-7)
    close = 0.02 if noise else 1e-5  # B and D come from other regressions
    np.testing.assert_allclose(markov(ours, ours.B), markov(theirs, theirs.B), atol=close)


def test_scale_of_the_signals_does_not_matter() -> None:
    y, u = data(2000, 1.0)
    one = identify(lag_gram(y, u, 8), order=3).model
    two = identify(lag_gram(1e6 * y, 1e-5 * u, 8), order=3).model
    np.testing.assert_allclose(two.poles, one.poles, rtol=1e-6)
    np.testing.assert_allclose(two.gains, 1e11 * one.gains, rtol=1e-6)
    np.testing.assert_allclose(two.R, 1e12 * one.R, rtol=1e-6)


def test_order_criterion_follows_its_formula() -> None:
    sigma = np.array([0.9, 0.5, 0.1])
    expected = [0.81, 0.25 + 3 * np.log(500) / 500, 0.01 + 6 * np.log(500) / 500, 9 * np.log(500) / 500]
    np.testing.assert_allclose(order_criterion(sigma, 500, 1, 1), expected)


@pytest.mark.parametrize(
    ("N", "order", "scale", "word"),
    [(20, 1, 1.0, "too few"), (500, 40, 1.0, "orders 1 … 14"), (500, 2, 0.0, "zero throughout")],
)
def test_mistakes_are_told(N: int, order: int, scale: float, word: str) -> None:
    y, u = data(500, 1.0)
    with pytest.raises(LogError, match=word):
        identify(lag_gram(y[:N], scale * u[:N], 8), order=order)
