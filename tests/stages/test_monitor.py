"""The monitor on the throttle, on another plant, as printed, and what a user can get wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError, RecipeError
from ingest.log import Log
from ingest.simulators.faults import Fault
from ingest.simulators.throttle import FAULTS, Throttle, plant_coefficients, simulate_throttle
from pipeline.recipe import load_recipe
from stages.align import Align
from stages.monitor import Monitor
from stages.stage import ANALYSIS, Stage, transform

ALIGN = Align(signals=("theta_ang", "e_a"))
(THROTTLE,) = (s for s in load_recipe("throttle").stages if isinstance(s, Monitor))
SETTINGS: dict[str, Any] = {
    "input": "e_a", "output": "theta_ang", "rate_hz": 1e4, "sensor": "tps", "plant": "et", "plant_order": 3,
    "drifting": (2,), "faults": THROTTLE.faults,
}  # fmt: skip


def rows(log: Log, **settings: Any) -> pl.DataFrame:
    return transform([ALIGN, Monitor(**SETTINGS | settings)], log).groups[ANALYSIS].frame


def named(frame: pl.DataFrame) -> str:
    """The most probable hypothesis at the end, ``none`` without an alarm."""
    last = frame.row(-1, named=True)
    p = {c.removeprefix("p."): v for c, v in last.items() if c.startswith("p.")}
    return max(p, key=lambda f: p[f]) if last["detection"] else "none"


@pytest.fixture(scope="module")
def healthy() -> pl.DataFrame:
    return rows(simulate_throttle(seed=11, duration_s=16.0), reference_s=6.0)


def test_indicators_are_the_simulated_parameters(healthy: pl.DataFrame) -> None:
    p = Throttle()
    k, *a = plant_coefficients(p)
    gain = p.k_TPS * p.sd_w_p
    truth = [p.tau_TPS, gain, k * p.k_TPS / gain, *a]
    mean = healthy.select("^indicator.*$").mean().row(0)
    np.testing.assert_allclose(mean, truth, rtol=0.05)
    assert healthy["noise_sd"].mean() == pytest.approx(p.sd_w_n, rel=0.1)
    assert healthy["time"].to_list() == pytest.approx(list(range(1, 17)))


def test_z_is_studentised_and_nothing_is_found(healthy: pl.DataFrame) -> None:
    z = healthy.select("^z.*$").drop_nulls().to_numpy()
    assert z.shape == (13, 6)  # from the fourth window on, against the reference so far
    assert 0.6 < z.std() < 1.4
    assert healthy["detection"].sum() == 0
    value, sigma, score = (healthy[c][-1] for c in ("indicator.a2", "sigma.a2", "z.a2"))
    before = healthy["indicator.a2"].head(6).to_numpy()
    assert before.min() < value - score * sigma < before.max()  # the healthy value


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named(fault: str) -> None:
    magnitude = 0.5 if fault == "tps_time_constant" else -0.4
    log = simulate_throttle(
        seed=12, duration_s=20.0, faults=[Fault(name=fault, magnitude=magnitude, onset_s=8.0, ramp_s=12.0)]
    )
    frame = rows(log, reference_s=7.0)
    assert named(frame) == fault
    assert frame.filter(pl.col("time") <= 8.5)["detection"].sum() == 0
    p = frame.filter(pl.col("detection") == 1).select("^p\\..*$").sum_horizontal()
    np.testing.assert_allclose(p, 1.0, atol=1e-6)
    size, sd = frame[f"size.{fault}"][-1], frame[f"size_sd.{fault}"][-1]
    assert abs(size - magnitude) < 4 * sd + 0.01


def test_moving_windows_say_the_same_more_often() -> None:
    """A quarter of each window is new: four times the rows, and no more evidence than there is."""
    log = simulate_throttle(
        seed=21, duration_s=18.0, faults=[Fault(name="tps_gain", magnitude=-0.2, onset_s=9.0, ramp_s=9.0)]
    )
    adjoining, moving = (rows(log, reference_s=8.0, step_s=step_s) for step_s in (0.0, 0.25))
    assert moving["time"].to_list() == pytest.approx(np.arange(1.0, 18.01, 0.25).tolist())
    assert named(moving) == named(adjoining) == "tps_gain"
    assert moving.filter(pl.col("time") <= 9.5)["detection"].sum() == 0
    assert 0.6 < moving.filter(pl.col("time") <= 9.0).select("^z.*$").drop_nulls().to_numpy().std() < 1.4
    same = moving.gather_every(4)
    for name in ("indicator.tau_tps", "indicator.a2"):
        np.testing.assert_allclose(same[name], adjoining[name], rtol=0.1)
    late = adjoining["time"] > 14.0
    ratio = (same["evidence.tps_gain"] / adjoining["evidence.tps_gain"]).filter(late).to_numpy()
    assert ratio.min() > 0.75
    assert ratio.max() < 1.35
    assert moving["size.tps_gain"][-1] == pytest.approx(-0.2, abs=0.02)


def test_a_wrong_minimum_is_left() -> None:
    """A start with a sensor as slow as a plant pole ends in the right place all the same."""
    log = simulate_throttle(seed=3, duration_s=2.0)
    y, u = log.values("theta_ang"), log.values("e_a")
    estimator = Monitor(**SETTINGS)._estimator
    first = estimator.estimate(u[:10_000], y[:10_000], None, None)
    assert first is not None
    assert first.memory is not None
    off = first.memory.parameters + np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    after = estimator.estimate(u[10_000:], y[10_000:], replace(first.memory, parameters=off), first.state)
    assert after is not None
    assert after.x[0] == pytest.approx(np.log(Throttle().tau_TPS), abs=0.2)


def test_a_wrong_minimum_is_not_taken_for_colour() -> None:
    """Here all fits with white disturbance end where the sensor is too slow; one with a coloured does not."""
    log = simulate_throttle(seed=84002, duration_s=1.0)
    y, u = log.values("theta_ang"), log.values("e_a")
    monitor = Monitor(**SETTINGS)
    estimate = monitor._estimator.estimate(u, y, None, None)
    assert estimate is not None
    assert estimate.memory is not None
    assert estimate.memory.colour == 0.0
    p = Throttle()
    expected = np.log([p.tau_TPS, p.k_TPS * p.sd_w_p])
    np.testing.assert_allclose(estimate.x[:2], expected, atol=0.15)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ((("R_a", 0.4),), "unknown"),
        ((("tps_time_constant", 0.5), ("tps_gain", -0.4)), "unknown"),
        ((("sd_w_n", 1.0),), "none"),
    ],
)
def test_what_is_not_listed(changes: tuple[tuple[str, float], ...], expected: str) -> None:
    faults = [Fault(name=name, magnitude=m, onset_s=8.0, ramp_s=3.0) for name, m in changes]
    assert (
        named(rows(simulate_throttle(seed=13, duration_s=18.0, faults=faults), reference_s=7.0)) == expected
    )


@pytest.mark.parametrize(
    ("tau", "gain", "fault"), [(0.0, 0.0, "none"), (1.0, 0.0, "slow"), (0.0, -0.3, "weak")]
)
def test_another_sensor_on_another_plant(
    make_sensor_log: Callable[..., Log], tau: float, gain: float, fault: str
) -> None:
    monitor = Monitor(
        input="u", output="y", rate_hz=100.0, sensor="s", plant="p", plant_order=1, window_s=10.0,
        reference_s=80.0, decimation=5, horizon=8,
        faults={
            "slow": {"tau_s": "1 + m"}, "weak": {"k_s": "1 + m"}, "plant": {"a1": "1 + m", "k_p": "1 + m"},
        },
    )  # fmt: skip
    log = make_sensor_log(5, tau=tau, gain=gain)
    frame = transform([Align(signals=("y", "u")), monitor], log).groups[ANALYSIS].frame
    assert named(frame) == fault
    healthy = frame.head(14)
    assert healthy["indicator.tau_s"].median() == pytest.approx(0.02, rel=0.1)
    assert healthy["indicator.a1"].median() == pytest.approx(2.0, rel=0.1)


def test_a_stored_reference_judges_from_the_first_window() -> None:
    learned = Monitor(**SETTINGS).fit([transform([ALIGN], simulate_throttle(seed=14, duration_s=10.0))])
    log = simulate_throttle(
        seed=15, duration_s=8.0, faults=[Fault(name="tps_gain", magnitude=-0.3, onset_s=0.0)]
    )
    frame = transform([ALIGN, learned], log).groups[ANALYSIS].frame
    assert named(frame) == "tps_gain"
    assert frame["size.tps_gain"][-1] == pytest.approx(-0.3, abs=0.05)
    assert frame["z.k_tps"].null_count() <= 1


def test_as_printed_a_slower_sensor_looks_weaker_too() -> None:
    """The printed estimator runs beside the corrected one and shows its faults."""
    log = simulate_throttle(
        seed=16, duration_s=30.0, faults=[Fault(name="tps_time_constant", magnitude=1.0, onset_s=15.0)]
    )
    frame = rows(log, estimator="printed", reference_s=14.0)
    assert frame["noise_sd"].null_count() == frame.height
    d = np.log(frame["indicator.k_tps"].to_numpy())
    assert np.nanmedian(d[15:]) - np.nanmedian(d[:14]) < -0.15
    corrected = np.log(rows(log, reference_s=14.0)["indicator.k_tps"].to_numpy())
    assert abs(np.nanmedian(corrected[15:]) - np.nanmedian(corrected[:14])) < 0.05


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"plant_order": 0}, "plant_order = 0"),
        ({"reference_s": 1.0}, "three|at least 3 windows"),
        ({"step_s": 2.0}, "step_s = 2 must be 0, or"),
        ({"window_s": 0.05}, "window_s = 0.05 is 500 samples"),
        ({"drifting": (4,)}, r"drifting = \[4\]"),
        ({"forgetting": 0.0}, "forgetting = 0"),
        ({"faults": {"f": {"tau_tsp": "1 + m"}}}, "did you mean tau_tps"),
    ],
)
def test_wrong_settings_are_told(settings: dict[str, Any], word: str) -> None:
    with pytest.raises(RecipeError, match=word):
        Monitor(**SETTINGS | settings)


def test_another_rate_and_too_few_healthy_windows_are_told() -> None:
    log = simulate_throttle(seed=1, duration_s=2.0)
    with pytest.raises(LogError, match="rate_hz"):
        rows(log, rate_hz=5e3, window_s=2.0)
    with pytest.raises(LogError, match="usable windows in the fault-free logs"):
        Monitor(**SETTINGS).fit([transform([ALIGN], log)])


def test_stage_protocol() -> None:
    stage: Stage = Monitor(**SETTINGS)
    assert stage.needs == {"e_a", "theta_ang"}
