"""Sensors of second order: theory, estimates from scratch, and what the monitor says of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import cont2discrete

from ingest.errors import RecipeError
from ingest.log import Group, Log
from ingest.physics import zero_order_hold
from stages.compensate import Compensate
from stages.innovations import fit, noise_of
from stages.monitor import Monitor
from stages.stage import ANALYSIS, transform
from stages.structure import Structure, coloured, pack, sensor_polynomial
from stages.two_rate import TwoRate

Array = NDArray[np.float64]
DT, LAG, SHAPE, GAIN, A1, SD_P, SD_N = 1e-3, 5.5e-3, 0.2, 2.0, 20.0, 0.05, 0.01
"""A plant with a lag of 50 ms; a sensor with lags of 4 and 1.5 ms where its shape r is 0.2."""
STRUCTURE = Structure(plant_order=1, sensor_order=2, dt=DT, drifting=(1,))
SETTINGS: dict[str, Any] = {
    "input": "u", "output": "y", "rate_hz": 1 / DT, "sensor": "s", "plant": "p", "plant_order": 1,
    "sensor_order": 2, "drifting": (1,), "window_s": 2.0, "reference_s": 24.0, "decimation": 6, "horizon": 12,
    "faults": {
        "slow": {"lag_s": "1 + m"}, "weak": {"k_s": "1 + m"}, "plant": {"a1": "1 + m", "k_p": "1 + m"},
    },
}  # fmt: skip


def window(seed: int, samples: int = 6000, r: float = SHAPE, **change: float) -> tuple[Array, Array]:
    """Input and reading; over the second half ``lag``, ``gain`` or ``plant`` is 1 + change times as large."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=samples // 20 + 1), 20)[:samples]
    w, noise = rng.normal(scale=SD_P, size=samples), rng.normal(scale=SD_N, size=samples)
    x, y = np.zeros(3), np.empty(samples)
    for half in (0, 1):
        factor = {k: 1.0 + half * change.get(k, 0.0) for k in ("lag", "gain", "plant")}
        tau, a = LAG * factor["lag"], A1 * factor["plant"]
        rate = 1.0 / (r * tau)
        A = np.array([[-a, 0.0, 0.0], [0.0, 0.0, 1.0 / tau], [rate, -rate, -rate]])
        Ad, Bd = zero_order_hold(A, np.array([[GAIN * a, 0.0], [0.0, 0.0], [0.0, rate]]), DT)
        for t in range(half * samples // 2, (half + 1) * samples // 2):
            y[t] = factor["gain"] * x[1] + noise[t]
            x = Ad @ x + Bd @ np.array([u[t], w[t]])
    return u, y


@given(st.floats(0.05, 3.0), st.floats(0.06, 0.9))
def test_its_denominator_is_that_of_the_sampled_system(step: float, r: float) -> None:
    alpha, slopes = sensor_polynomial(step, r)
    _, expected, _ = cont2discrete(([1.0], [r, 1.0, 1.0]), step)
    np.testing.assert_allclose(alpha, expected[1:], atol=1e-9)
    for row, (by_tau, by_r) in enumerate(((1e-6, 0.0), (0.0, 1e-6))):
        up, down = (sensor_polynomial(step * np.exp(-k * by_tau), r * np.exp(k * by_r))[0] for k in (1, -1))
        np.testing.assert_allclose(slopes[row], (up - down) / 2e-6, atol=1e-7)


@given(st.floats(0.1, 1.0), st.floats(0.08, 0.9), st.floats(0.003, 0.3), st.sampled_from([0.0, 0.7]))
def test_spectra_of_both_descriptions_agree(step: float, r: float, sd_n: float, phi: float) -> None:
    """C(q) of ``|C|^2 s2 = sd_p^2 |B|^2 + sd_n^2 |A|^2`` by its roots gives sd_p and sd_n back."""
    numerator, denominator, _ = cont2discrete(([1.0], [r, 1.0, 1.0]), step)
    alpha = coloured(denominator[1:], phi)
    A, B = np.append(1.0, alpha), np.pad(numerator.ravel()[1:], (1, alpha.size - 2))
    even = np.convolve(B, B[::-1]) + sd_n**2 * np.convolve(A, A[::-1])
    roots = np.roots(even)
    C = np.real(np.poly(sorted(roots, key=abs)[: alpha.size]))
    s2 = even[0] / C[-1]
    k2, n2 = noise_of(1.0, r, C[1:], s2, step, phi)
    assert n2 == pytest.approx(sd_n**2, rel=1e-4)
    assert k2 == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("colour", [0.0, 0.6])
def test_sensitivities_are_those_of_finite_differences(colour: float) -> None:
    """For a plant of second order with a zero."""
    structure = Structure(plant_order=2, zeros=1, sensor_order=2, dt=DT, drifting=(1,), colour=colour)
    rest = [0.4, np.log(SHAPE), -0.3, 0.1, 0.05][: 4 + bool(colour)]
    truth = pack(LAG, 3000.0, np.array([120.0, 2000.0]), np.array(rest))
    u, y = window(1, 500)
    w = np.array([0.0, 0.0, 0.0, 0.0, 0.05, -0.04, 0.0])
    G, end = structure.gram(truth, w, u, y)
    assert end.shape == (4,)
    for i, h in enumerate(1e-5 * np.eye(truth.size)):
        up, down = (structure.gram(truth + s * h, w, u, y)[0][-1, -1] for s in (1, -1))
        assert -2 * G[i, -1] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-6)
    for i, h in enumerate(1e-3 * np.eye(w.size)[:6]):  # responses to the state and to drifts
        up, down = (structure.gram(truth, w + s * h, u, y)[0][-1, -1] for s in (1, -1))
        assert -2 * G[truth.size + i, -1] == pytest.approx((up - down) / 2e-3, rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("r", [SHAPE, 0.5])
def test_it_is_found_from_scratch(r: float) -> None:
    """With two lags and with an oscillation; z is studentised, and so is the shape's logarithm."""
    start, z = TwoRate(decimation=6, horizon=12), []
    truth = np.log([LAG, SD_P, GAIN * A1 / SD_P, A1])
    for seed in range(8):
        u, y = window(seed, r=r)
        fits = [
            fit(STRUCTURE, u, y, p, p, np.zeros((p.size,) * 2)) for p in start.starts(STRUCTURE, u, y, None)
        ]
        best = min(fits, key=lambda f: f.loss)
        x, P, _ = best.indicators
        off = np.append(x - truth, best.p[3] - np.log(r))
        z.append(off / np.sqrt(np.append(np.diag(P), best.covariance[3, 3])))
        assert best.noise[1] == pytest.approx(SD_N, rel=0.15)
        assert (np.sqrt(np.diag(P)) < [0.007, 0.035, 0.035, 0.004]).all()
    assert np.abs(np.mean(z, axis=0)).max() < 3.0 / np.sqrt(len(z))
    assert 0.5 < np.std(z) < 1.5


def test_as_a_sensor_of_first_order_it_is_not_found() -> None:
    u, y = window(3)
    p = pack(LAG, GAIN * A1, np.array([A1]), np.array([np.log(SHAPE), -0.3, 0.0]))
    first = np.delete(p, [3, 5])
    right = fit(STRUCTURE, u, y, p, p, np.zeros((6, 6)))
    wrong = fit(replace(STRUCTURE, sensor_order=1), u, y, first, first, np.zeros((4, 4)))
    assert wrong.loss > right.loss + 100.0


@pytest.mark.parametrize(
    ("change", "expected", "size"),
    [
        ({}, "none", 0.0),
        ({"lag": 0.1}, "slow", 0.1),
        ({"gain": -0.1}, "weak", -0.1),
        ({"plant": 0.1}, "plant", 0.1),
    ],
)
def test_it_is_monitored(change: dict[str, float], expected: str, size: float) -> None:
    u, y = window(11, 80_000, **change)
    frame = pl.DataFrame({"time": np.arange(u.size) * DT, "u": u, "y": y})
    log = Log("x", {ANALYSIS: Group(ANALYSIS, frame)})
    rows = transform([Monitor(**SETTINGS)], log).groups[ANALYSIS].frame
    p = rows.select("^p\\..*$").row(-1, named=True)
    said = max(p, key=p.__getitem__).removeprefix("p.") if rows["detection"][-1] else "none"
    assert said == expected
    assert rows.filter(pl.col("time") <= 40.0)["detection"].sum() == 0
    assert rows["indicator.lag_s"].head(20).median() == pytest.approx(LAG, rel=0.02)
    if expected != "none":
        assert rows[f"size.{expected}"][-1] == pytest.approx(size, abs=0.03)


def test_its_gain_can_be_compensated_its_dynamics_not() -> None:
    monitor = Monitor(**SETTINGS)
    gain = Compensate(signal="y", sensor="s", faults={"weak": "gain"})
    dynamics = Compensate(signal="y", sensor="s", faults={"slow": "time_constant"})
    assert gain.needs <= monitor.adds
    assert dynamics.needs - monitor.adds == {"indicator.tau_s", "sigma.tau_s", "z.tau_s"}


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"sensor_order": 3}, "sensor_order = 3 must be 1 or 2"),
        ({"sensor_order": 0}, "sensor_order = 0 must be 1 or 2"),
        ({"estimator": "printed"}, "'printed' knows a sensor of first order only"),
        ({"sensor_order": 1}, "'lag_s'; known: a1, k_p, k_s, tau_s"),
    ],
)
def test_wrong_orders_are_told(settings: dict[str, Any], word: str) -> None:
    with pytest.raises(RecipeError, match=word):
        Monitor(**SETTINGS | settings)
