"""The structured fit against theory, finite differences and simulated windows."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lfilter

from ingest.simulators.throttle import Throttle, plant_coefficients, simulate_throttle
from stages.innovations import Fit, _covariances, fit
from stages.structure import Structure, pack, unpack

Array = NDArray[np.float64]
P = Throttle()
B, *A_I = plant_coefficients(P)
TRUTH = pack(P.tau_TPS, B * P.k_TPS, np.array(A_I), np.array([-0.09]))
STRUCTURE = Structure(plant_order=3, dt=1e-4, drifting=(2,))
FREE = np.zeros((6, 6))


def window(seed: int, samples: int = 10_000, **overrides: float) -> tuple[Array, Array]:
    log = simulate_throttle(seed=seed, duration_s=1.0 + samples * 1e-4, overrides=overrides)
    return log.values("e_a")[10_000:], log.values("theta_ang")[10_000:]


@settings(max_examples=50, deadline=None)
@given(st.floats(1e-4, 1e-3), st.floats(1e-4, 1e-1), st.floats(2e-4, 1e-2))
def test_spectra_of_both_descriptions_agree(tau: float, k_w: float, sd_n: float) -> None:
    """k^2 |(1-a) / (e^jw - a)|^2 + sd_n^2 = s2 |(e^jw - c) / (e^jw - a)|^2, solved for c and s2, gives k,
    sd_n back."""
    a = np.exp(-1e-4 / tau)
    # (1 + a^2 - 2 a cos w) sd_n^2 + k^2 (1-a)^2 = s2 (1 + c^2 - 2 c cos w)
    even, odd = (1 + a * a) * sd_n**2 + (k_w * (1 - a)) ** 2, a * sd_n**2
    c = (even - np.sqrt(even**2 - 4 * odd**2)) / (2 * odd)
    p = pack(tau, 1.0, np.array([1.0]), np.array([-c]))
    found = Fit(
        p=p, covariance=np.eye(4), still=np.eye(4), variance=odd / c, state=np.zeros(2), loss=0.0,
        samples=100, dt=1e-4, plant_order=1,
    )  # fmt: skip
    assert found.noise == pytest.approx((k_w, sd_n), rel=1e-3)


def test_indicators_jacobian_is_that_of_finite_differences() -> None:
    base = Fit(
        p=TRUTH,
        covariance=np.diag(np.arange(1.0, 7.0)),
        still=0.5 * np.diag(np.arange(1.0, 7.0)),
        variance=2e-6,
        state=np.zeros(4),
        loss=0.0,
        samples=500,
        dt=1e-4,
        plant_order=3,
    )
    step, columns = 1e-6, []
    for i in range(6):
        moved = replace(base, p=TRUTH + step * np.eye(6)[i])
        columns.append((moved.indicators[0] - base.indicators[0]) / step)
    louder = replace(base, variance=base.variance * np.exp(step))
    J = np.stack([*columns, (louder.indicators[0] - base.indicators[0]) / step], axis=1)
    expected = J @ np.diag([*np.arange(1.0, 7.0), 2 / 500]) @ J.T
    np.testing.assert_allclose(base.indicators[1], expected, rtol=1e-4, atol=1e-6)
    own = 2 / 500 * np.outer(J[:, -1], J[:, -1])
    np.testing.assert_allclose(base.indicators[2] - own, 0.5 * (expected - own), rtol=1e-4, atol=1e-6)


def test_sensitivities_are_those_of_finite_differences() -> None:
    """J' e of the compiled loop is the derivative of the squares, the innovations being filtered from
    outside."""
    u, y = window(1, 800)
    w = np.array([0.0, 0.0, 0.0, 0.0, 0.05, -0.04, 0.0])

    def squares(p: Array) -> float:
        return float(STRUCTURE.gram(p, w, u, y)[0][-1, -1])

    G, _ = STRUCTURE.gram(TRUTH, w, u, y)
    for i in range(6):
        h = 1e-5 * np.eye(6)[i]
        slope = (squares(TRUTH + h) - squares(TRUTH - h)) / 2e-5
        assert -2 * G[i, -1] == pytest.approx(slope, rel=1e-4)


def test_innovations_are_those_of_a_filter() -> None:
    """From zero state: e = (q - a) / (q - c) (y - simulated)."""
    quiet = {"sd_w_p": 0.0, "sd_w_n": 0.0}
    log = simulate_throttle(seed=3, duration_s=0.2, overrides=quiet)
    u, y = log.values("e_a"), log.values("theta_ang")
    G, end = STRUCTURE.gram(TRUTH, np.zeros(7), u, y)
    assert G[-1, -1] < 1e-11 * u.size  # the simulator's log is float32
    assert end[0] / P.k_TPS == pytest.approx(log.values("truth.theta")[-1], abs=1e-3)
    noisy = y + np.random.default_rng(0).normal(size=y.size)
    a, c = np.exp(-1e-4 / P.tau_TPS), -TRUTH[-1]
    e = lfilter([1.0, -a], [1.0, -c], noisy - y)
    assert STRUCTURE.gram(TRUTH, np.zeros(7), u, noisy)[0][-1, -1] == pytest.approx(float(e @ e), rel=1e-4)


def test_estimates_are_unbiased_and_as_spread_as_they_say() -> None:
    """40 windows from the truth: z has standard deviation 1; so the Cramer-Rao bound is reached."""
    k = P.k_TPS * P.sd_w_p
    truth = np.log([P.tau_TPS, k, B * P.k_TPS / k, *A_I])
    z, sd = [], []
    for seed in range(8):
        log = simulate_throttle(seed=seed, duration_s=6.0)
        u, y = log.values("e_a"), log.values("theta_ang")
        for first in range(10_000, 60_000, 10_000):
            part = slice(first, first + 10_000)
            x, covariance, _ = fit(STRUCTURE, u[part], y[part], TRUTH, TRUTH, FREE).indicators
            sd.append(np.sqrt(np.diag(covariance)))
            z.append((x - truth) / sd[-1])
    assert np.abs(np.mean(z, axis=0)).max() < 3.0 / np.sqrt(len(z))
    np.testing.assert_allclose(np.std(z, axis=0), 1.0, atol=0.35)
    assert (np.median(sd, axis=0) < [0.06, 0.03, 0.035, 0.03, 0.03, 0.03]).all()


def test_covariance_at_rest_is_that_of_regressions_with_wrong_doubts() -> None:
    """Ridge regressions of pure noise: the spread of what they find, while the drifts are 0 and their means
    a priori have a spread of their own."""
    rng = np.random.default_rng(0)
    V, known, off = rng.normal(size=(30, 5)), np.array([0.0, 4.0, 9.0]), np.array([0.0, 0.3, 0.0])
    H = V.T @ V + np.diag([0.0, 0.0, *known])
    noise, mean = rng.normal(size=(40_000, 30)), off * rng.normal(size=(40_000, 3))
    found = np.linalg.solve(H, V.T @ noise.T + np.concatenate([np.zeros((2, 40_000)), (known * mean).T]))
    covariance, still = _covariances(H, 2, known * (1.0 - known * off**2))
    np.testing.assert_allclose(covariance, np.linalg.inv(H)[:2, :2])
    np.testing.assert_allclose(still, np.cov(found[:2]), rtol=0.05, atol=0.02 * np.abs(still).max())
    assert (np.diag(still) < np.diag(covariance)).all()


def test_where_nothing_drifts_the_doubt_of_a_drift_counts_less() -> None:
    u, y = window(4)
    found = fit(replace(STRUCTURE, input_drift_sd=0.01), u, y, TRUTH, TRUTH, FREE)
    sure = fit(STRUCTURE.stiff, u, y, TRUTH, TRUTH, FREE)
    _, doubted, still = (np.sqrt(np.diag(P)) if P.ndim == 2 else P for P in found.indicators)
    assert (still <= doubted * (1 + 1e-9)).all()
    assert still[5] < 0.97 * doubted[5]
    # estimated along, a drift costs, even where there is none
    assert (still >= 0.99 * np.sqrt(np.diag(sure.indicators[1]))).all()


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_converges_from_a_poor_start(factor: float) -> None:
    u, y = window(2)
    start = TRUTH + np.log(factor) * np.array([1.0, 0.2, 0.0, 0.3, -0.2, 0.0])
    one, two = fit(STRUCTURE, u, y, start, start, FREE), fit(STRUCTURE, u, y, TRUTH, TRUTH, FREE)
    np.testing.assert_allclose(one.p, two.p, atol=0.2 * np.sqrt(np.diag(two.covariance)).max())


def test_noise_of_both_kinds_is_told_apart() -> None:
    """Twice the measurement noise moves neither time constant nor gain."""
    for sd_n in (1e-3, 2e-3):
        u, y = window(5, 40_000, sd_w_n=sd_n)
        found = fit(STRUCTURE, u, y, TRUTH, TRUTH, FREE)
        k, n = found.noise
        assert n == pytest.approx(sd_n, rel=0.1)
        assert k == pytest.approx(P.k_TPS * P.sd_w_p, rel=0.06)


def test_a_window_at_rest_keeps_the_prior_and_says_so() -> None:
    u, y = window(6, pedal_min=0.5, pedal_max=0.5)
    prior = np.diag([4.0] * 5 + [0.0])
    state = np.array([P.k_TPS * 0.5, 0.0, 0.0, P.k_TPS * 0.5])
    found = fit(STRUCTURE, u, y, TRUTH, TRUTH, prior, state)
    sd = np.sqrt(np.diag(found.indicators[1]))
    assert (sd[:2] < 0.07).all()  # the noise tells of the sensor
    assert (sd[3:] > 0.2).all()


def test_pack_and_unpack() -> None:
    tau, b, a_i, z, r, gamma = unpack(TRUTH, 3)
    np.testing.assert_allclose(pack(tau, b, a_i, np.append(z, gamma)), TRUTH)
    assert z.size == 0
    assert r == 0.0
    np.testing.assert_allclose([tau, b, *a_i], [P.tau_TPS, B * P.k_TPS, *A_I], rtol=1e-9)


def test_coloured_disturbance_is_fitted_with_its_pole() -> None:
    """With phi known, tau, the measurement noise and the disturbance's innovations come out as simulated."""
    phi = float(np.exp(-1e-4 / 5e-4))
    coloured = replace(STRUCTURE, colour=phi)
    start = np.append(TRUTH[:-1], [0.0, 0.0])
    found = []
    for seed in range(4):
        u, y = window(seed, 20_000, tau_w_p=5e-4)
        found.append(fit(coloured, u, y, start, start, np.zeros((7, 7))))
    tau = np.exp([f.p[0] for f in found])
    assert np.mean(tau) == pytest.approx(P.tau_TPS, rel=0.15)
    k, n = np.mean([f.noise for f in found], axis=0)
    assert n == pytest.approx(P.sd_w_n, rel=0.2)
    assert k == pytest.approx(P.k_TPS * P.sd_w_p * np.sqrt(1 - phi**2), rel=0.15)


def test_compiled_loops_of_other_orders_are_not_taken_for_each_other(tmp_path: Path) -> None:
    """One compiled, the other compiled beside the first from the cache, then both from the cache."""
    code = (
        "import sys, numpy as np; from stages.structure import Structure, pack\n"
        "for n in map(int, sys.argv[1:]):\n"
        "    s, a = Structure(plant_order=n, dt=0.01), np.poly(-np.arange(1.0, n + 1.0))[1:]\n"
        "    z = np.random.default_rng(0).normal(size=(2, 99))\n"
        "    print(s.gram(pack(0.02, 1.0, a, np.array([-0.1])), np.zeros(n + 3), *z)[0].trace())"
    )
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_OPT": "1"}

    def run(*orders: str) -> list[str]:
        command = [sys.executable, "-c", code, *orders]
        done = subprocess.run(command, env=env, check=True, capture_output=True, text=True)
        return done.stdout.splitlines()

    first, both = run("2"), run("2", "1")
    assert run("2", "1") == both
    assert both[:1] == first
