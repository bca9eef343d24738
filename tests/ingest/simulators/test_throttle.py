"""The throttle simulator against (3.17), exact solutions and its own statistics."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.signal import welch

from ingest.errors import DynoscopeError
from ingest.log import Log
from ingest.simulators.faults import Fault
from ingest.simulators.throttle import FAULTS, Throttle, plant_coefficients, simulate_throttle

DT = 1e-4
QUIET = {"sd_w_p": 0.0, "sd_w_n": 0.0}


@pytest.fixture(scope="module")
def healthy() -> Log:
    return simulate_throttle(seed=4, duration_s=6.0)


def test_poles_are_those_of_the_published_throttle() -> None:
    k, *a = plant_coefficients(Throttle())
    assert k == pytest.approx(78895, rel=1e-3)
    time_constants = np.sort(-1.0 / np.roots([1.0, *a]).real)
    np.testing.assert_allclose(time_constants, [1.034e-3, 29.1e-3, 1.291], rtol=1e-3)


def test_the_log_obeys_the_differential_equations() -> None:
    """The held voltage through (3.15), (3.16) and the sensor, solved by an adaptive integrator."""
    log = simulate_throttle(seed=1, duration_s=0.3, overrides=QUIET)
    u, p = log.values("e_a"), Throttle()
    k, a1, a2, a3 = plant_coefficients(p)

    def slope(t: float, x: NDArray[np.float64]) -> list[float]:
        e = u[min(int(t / DT + 1e-6), u.size - 1)]
        jerk = k * e - a1 * x[2] - a2 * x[1] - a3 * x[0]
        return [x[1], x[2], jerk, (p.k_TPS * x[0] - x[3]) / p.tau_TPS]

    x = np.zeros(4)
    for t in range(0, 3000, 10):  # the voltage is constant over 1 ms
        x = solve_ivp(slope, (t * DT, (t + 10) * DT), x, rtol=1e-9, atol=1e-12, max_step=1e-3).y[:, -1]
        if t + 10 < 3000:
            assert x[3] == pytest.approx(log.values("theta_ang")[t + 10], abs=2e-6)
            assert x[0] == pytest.approx(log.values("truth.theta")[t + 10], abs=1e-6)


def test_voltage_is_held_and_limited(healthy: Log) -> None:
    u = healthy.values("e_a").reshape(-1, 10)
    assert np.ptp(u, axis=1).max() == 0.0
    assert np.abs(u).max() <= 12.0
    assert np.std(u) > 1.0


def test_noise_has_the_spectrum_of_its_two_sources() -> None:
    """S = k^2 sd_p^2 |(1-a) / (e^jw - a)|^2 + sd_n^2, at rest."""
    log = simulate_throttle(seed=2, duration_s=20.0, overrides={"pedal_min": 0.0, "pedal_max": 0.0})
    y, p = log.values("theta_ang"), Throttle()
    f, S = welch(y, fs=1 / DT, nperseg=1000)
    a = np.exp(-DT / p.tau_TPS)
    H = (1 - a) / np.abs(np.exp(2j * np.pi * f * DT) - a)
    expected = 2 * DT * ((p.k_TPS * p.sd_w_p * H) ** 2 + p.sd_w_n**2)
    np.testing.assert_allclose(S[5:-5], expected[5:-5], rtol=0.35)
    assert np.mean(S[5:-5] / expected[5:-5]) == pytest.approx(1.0, abs=0.02)


def test_closed_loop_makes_the_voltage_depend_on_the_noise() -> None:
    def voltages(closed: float) -> list[NDArray[np.float64]]:
        return [
            simulate_throttle(seed=3, duration_s=1.0, noise=x, overrides={"closed_loop": closed}).values(
                "e_a"
            )
            for x in (0.0, 1.0)
        ]

    quiet, noisy = voltages(0.0)
    np.testing.assert_array_equal(quiet, noisy)
    quiet, noisy = voltages(1.0)
    assert np.std(quiet - noisy) > 0.01


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_changes_nothing_before_its_onset_and_the_reading_after(name: str, healthy: Log) -> None:
    faulty = simulate_throttle(
        seed=4, duration_s=6.0, faults=[Fault(name=name, magnitude=0.4, onset_s=2.0, ramp_s=2.0)]
    )
    before = healthy.values("theta_ang")[:20000]
    np.testing.assert_array_equal(faulty.values("theta_ang")[:20000], before)
    assert np.abs(faulty.values("theta_ang") - healthy.values("theta_ang"))[20000:].max() > 1e-3
    (event,) = faulty.events
    assert (event.kind, event.t_start, event.magnitude, event.source) == (name, 2.0, 0.4, "truth")
    assert event.channel == ("theta_ang" if name.startswith("tps") else None)


def test_gain_fault_is_a_gain_of_the_reading_and_not_of_the_truth() -> None:
    log = simulate_throttle(
        seed=5, duration_s=3.0, overrides=QUIET,
        faults=[Fault(name="tps_gain", magnitude=-0.4, onset_s=1.0)],
    )  # fmt: skip
    ratio = log.values("theta_ang")[11000:] / log.values("truth.theta_ang")[11000:]
    np.testing.assert_allclose(ratio, 0.6, rtol=1e-5)


def test_any_varying_parameter_can_drift_and_two_at_once() -> None:
    faults = [
        Fault(name="R_a", magnitude=0.3, onset_s=1.0),
        Fault(name="sd_w_n", magnitude=1.0, onset_s=1.0),
    ]
    log = simulate_throttle(seed=6, duration_s=2.0, faults=faults, overrides={"sd_w_p": 0.0})
    noise = log.values("theta_ang") - log.values("truth.theta_ang")
    assert noise[:10000].std() == pytest.approx(1e-3, rel=0.05)
    assert noise[10000:].std() == pytest.approx(2e-3, rel=0.05)
    assert [e.kind for e in log.events] == ["R_a", "sd_w_n"]


def test_every_mistake_is_told_at_once() -> None:
    with pytest.raises(DynoscopeError) as error:
        simulate_throttle(
            faults=[Fault(name="tps_gian", magnitude=0.1), Fault(name="R_a", magnitude=-2.0)],
            overrides={"Ra": 1.0, "L_a": 0.0},
            seed=-1,
        )
    for part in ("tps_gain", "-2", "'Ra'", "L_a = 0", "seed -1"):
        assert part in str(error.value)
