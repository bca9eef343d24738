"""Plants with zeros: sensitivities, starts and estimates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete

from ingest.errors import RecipeError
from ingest.log import Group, Log
from ingest.physics import zero_order_hold
from stages.innovations import fit
from stages.monitor import Monitor
from stages.stage import ANALYSIS, transform
from stages.statespace import StateSpace
from stages.structure import Structure, pack
from stages.two_rate import TwoRate

Array = NDArray[np.float64]
DT, TAU, GAIN, A_I, ZERO = 1e-3, 2e-3, 2.0, np.array([220.0, 4000.0]), 0.02
"""A plant with poles at -20/s and -200/s and a zero at -50/s, and a sensor of 2 ms."""
RELATIVE = ZERO * np.sqrt(A_I[-1])
TRUTH = pack(TAU, GAIN * A_I[-1], A_I, np.array([RELATIVE, -0.3]))
STRUCTURE = Structure(plant_order=2, zeros=1, dt=DT, drifting=(1,))


def window(seed: int, samples: int = 4000, lost: float = 0.0) -> tuple[Array, Array]:
    """Input and reading, with disturbance before and noise behind the sensor, whose gain is ``lost`` bit by
    bit over the second half."""
    rng = np.random.default_rng(seed)
    A = np.array([[0.0, 1.0, 0.0], [-A_I[1], -A_I[0], 0.0], [1 / TAU, ZERO / TAU, -1 / TAU]])
    B = np.array([[0.0, 0.0], [GAIN * A_I[1], 0.0], [0.0, 1 / TAU]])
    Ad, Bd = zero_order_hold(A, B, DT)
    u = np.repeat(rng.normal(size=samples // 20 + 1), 20)[:samples]
    x, y, w = np.zeros(3), np.empty(samples), rng.normal(scale=0.05, size=samples)
    for t in range(samples):
        y[t] = (1.0 - lost * max(0.0, 2.0 * t / samples - 1.0)) * x[2] + rng.normal(scale=0.01)
        x = Ad @ x + Bd @ np.array([u[t], w[t]])
    return u, y


def test_sensitivities_are_those_of_finite_differences() -> None:
    u, y = window(1, 500)
    w = np.array([0.0, 0.0, 0.0, 0.05, -0.04, 0.0])
    G, _ = STRUCTURE.gram(TRUTH, w, u, y)
    for i, h in enumerate(1e-5 * np.eye(TRUTH.size)):
        up, down = (STRUCTURE.gram(TRUTH + s * h, w, u, y)[0][-1, -1] for s in (1, -1))
        assert -2 * G[i, -1] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-6)


def test_a_plant_with_a_zero_is_found_from_scratch() -> None:
    """From the subspace start; z is studentised, and the zero is where it is."""
    start, off = TwoRate(decimation=4, horizon=12), []
    for seed in range(8):
        u, y = window(seed)
        fits = [
            fit(STRUCTURE, u, y, p, p, np.zeros((p.size,) * 2)) for p in start.starts(STRUCTURE, u, y, None)
        ]
        best = min(fits, key=lambda f: f.loss)
        x, P, _ = best.indicators
        k = 0.05
        truth = np.log([TAU, k, GAIN * A_I[-1] / k, *A_I])
        off.append((x - truth) / np.sqrt(np.diag(P)))
        assert best.p[4] == pytest.approx(RELATIVE, abs=4 * np.sqrt(best.covariance[4, 4]))
    assert np.abs(np.mean(off, axis=0)).max() < 3.0 / np.sqrt(len(off))
    assert np.std(off) < 1.5


def test_without_its_zero_the_plant_is_not_found() -> None:
    u, y = window(3)
    p = np.delete(TRUTH, 4)
    none = np.zeros((p.size, p.size))
    with_zero = fit(STRUCTURE, u, y, TRUTH, TRUTH, np.zeros((TRUTH.size,) * 2))
    without = fit(replace(STRUCTURE, zeros=0), u, y, p, p, none)
    assert without.loss > with_zero.loss + 100.0


@pytest.mark.parametrize(("lost", "expected"), [(0.0, "none"), (0.3, "weak")])
def test_its_sensor_is_monitored(lost: float, expected: str) -> None:
    u, y = window(7, 120_000, lost)
    frame = pl.DataFrame({"time": np.arange(u.size) * DT, "u": u, "y": y})
    monitor = Monitor(
        input="u", output="y", rate_hz=1 / DT, sensor="s", plant="p", plant_order=2, plant_zeros=1,
        window_s=4.0, decimation=4, horizon=12, reference_s=40.0,
        faults={"weak": {"k_s": "1 + m"}, "slow": {"tau_s": "1 + m"}},
    )  # fmt: skip
    rows = transform([monitor], Log("x", {ANALYSIS: Group(ANALYSIS, frame)})).groups[ANALYSIS].frame
    p = rows.select("p.weak", "p.slow", "p.unknown").row(-1, named=True)
    said = max(p, key=p.__getitem__).removeprefix("p.") if rows["detection"][-1] else "none"
    assert said == expected
    assert rows.filter(pl.col("time") <= 60.0)["detection"].sum() == 0


@pytest.mark.parametrize("zeros", [-1, 2])
def test_too_many_zeros_are_refused(zeros: int) -> None:
    with pytest.raises(RecipeError, match=f"plant_zeros = {zeros} must be 0 or more, and fewer than"):
        Monitor(
            input="u", output="y", rate_hz=1e3, sensor="s", plant="p", plant_order=2, plant_zeros=zeros,
            window_s=4.0, faults={},
        )  # fmt: skip


def test_numerators_are_those_of_the_system_behind_the_samples() -> None:
    """Of [s^2 z + s y + 1, -0.3 s + 2] / A(s), sampled and transformed by any T."""
    A, C = np.array([[-30.0, -900.0], [1.0, 0.0]]), np.array([[0.04, 1.0], [-0.3, 2.0]])
    B, D = np.array([[1.0], [0.0]]), np.array([[0.0], [0.0]])
    Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, C, D), 0.004)
    T = np.array([[1.0, 0.4], [-0.2, 2.0]])
    model = StateSpace(
        A=T @ Ad @ np.linalg.inv(T), B=T @ Bd, C=Cd @ np.linalg.inv(T), D=Dd, K=np.zeros((2, 2)),
        R=np.eye(2), dt=0.004,
    )  # fmt: skip
    np.testing.assert_allclose(model.numerators[:, 0], [[1.0, 0.04, 0.0], [1.0, -0.15, 0.0]], atol=1e-9)
