"""The simulated log: contract, repeatability, faults as they show, plausibility, speed."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import DynoscopeError
from ingest.log import Log
from ingest.simulators.airpath import _KINDS, PARAMETERS, Fault, simulate_airpath
from ingest.simulators.faults import SENSORS

Array = NDArray[np.float64]
SHORT: dict[str, Any] = {"cycle": "us06", "duration_s": 120.0}
ONSET = 60.0


@pytest.fixture(scope="module")
def healthy() -> Log:
    return simulate_airpath(**SHORT)


@pytest.fixture(scope="module")
def wltc() -> Log:
    return simulate_airpath(overrides={"variation": 0.0})


def faulty(name: str, magnitude: float, **more: Any) -> Log:
    return simulate_airpath(**SHORT, faults=[Fault(name=name, magnitude=magnitude, onset_s=ONSET, **more)])


def test_log_keeps_its_contract(healthy: Log) -> None:
    ecu, truth = healthy.groups["ecu"], healthy.groups["truth"]
    assert (ecu.rate_hz, truth.rate_hz) == pytest.approx((50.0, 10.0))
    np.testing.assert_array_equal(truth.time, ecu.time[::5])
    wanted = {"p_Bst", "p_Int", "p_Exh", "p_Amb", "T_Bst", "T_Int", "T_Amb", "W_HFM", "W_Fuel", "n_Eng"}
    assert wanted | {"theta_Thr", "u_Egr", "u_Vnt", "v_Veh", "n_Turb", "lambda"} == set(ecu.signals)
    assert all(s.unit and s.description for s in healthy.signals.values())
    assert not any(ecu.frame.null_count().row(0))
    assert [(e.kind, e.source) for e in healthy.events] == [("none", "truth")]
    assert {"simulator", "cycle", "seed", "tolerance", "egr", "vehicle", "overrides", "tolerances"} <= set(
        healthy.facts
    )
    for s in SENSORS:  # without a fault the healthy reading is the reading
        np.testing.assert_array_equal(healthy.values(f"truth.{s}"), healthy.values(s)[::5])


def test_same_seed_same_log_and_another_seed_another(healthy: Log) -> None:
    assert simulate_airpath(**SHORT).equals(healthy)
    other = simulate_airpath(**SHORT, seed=1)
    assert np.abs(other.values("W_HFM") - healthy.values("W_HFM")).mean() > 0.3
    assert other.facts["variation"] != healthy.facts["variation"]


@pytest.mark.parametrize(
    ("name", "magnitude", "signal"),
    [
        ("maf_gain", 0.1, None),
        ("boost_pressure_gain", -0.05, None),
        ("boost_leak", 6.0, None),
        ("intake_leak", 6.0, None),
        ("egr_stuck_open", 12.0, None),
        ("sensor_noise", 0.1, "p_Int"),
        ("sensor_stuck", 0.0, "T_Int"),
    ],
)
def test_before_its_onset_a_fault_changes_nothing(
    healthy: Log, name: str, magnitude: float, signal: str | None
) -> None:
    log = faulty(name, magnitude, signal=signal)
    before, after = healthy.between(0.0, ONSET), healthy.between(ONSET, 1e9)
    assert log.between(0.0, ONSET).groups["ecu"].frame.equals(before.groups["ecu"].frame)
    assert log.between(0.0, ONSET).groups["truth"].frame.equals(before.groups["truth"].frame)
    assert not log.between(ONSET, 1e9).groups["ecu"].frame.equals(after.groups["ecu"].frame)
    assert [(e.kind, e.t_start, e.magnitude) for e in log.events] == [(name, ONSET, magnitude)]


@pytest.mark.parametrize(
    ("name", "signal", "gain", "tolerance"),
    [
        ("maf_gain", "W_HFM", 1.07, 1e-6),
        ("intake_temperature_gain", "T_Int", 1.07, 1e-6),
        ("boost_pressure_gain", "p_Bst", 1.07, 2e-4),  # noise of the converter is added after the sensor
        ("intake_pressure_gain", "p_Int", 1.07, 2e-4),
    ],
)
def test_a_gain_multiplies_what_the_healthy_sensor_reads(
    name: str, signal: str, gain: float, tolerance: float
) -> None:
    log = faulty(name, gain - 1.0).between(ONSET + 2.0, 1e9)
    np.testing.assert_allclose(log.values(signal)[::5], gain * log.values(f"truth.{signal}"), rtol=tolerance)


def test_offset_drifts_and_ends() -> None:
    log = faulty("sensor_offset", 4.0, signal="T_Int", ramp_s=20.0, end_s=100.0)
    t, difference = log.groups["truth"].time, log.values("T_Int")[::5] - log.values("truth.T_Int")
    expected = np.where(t < 100.0, 4.0 * np.clip((t - ONSET) / 20.0, 0.0, 1.0), 0.0)
    np.testing.assert_allclose(difference, expected, atol=1e-4)


def test_stuck_holds_the_last_reading_and_minus_one_reads_zero() -> None:
    held = faulty("sensor_stuck", 0.0, signal="W_HFM").between(ONSET, 1e9).values("W_HFM")
    assert np.ptp(held) == 0.0
    assert held[0] > 5.0
    assert (faulty("sensor_stuck", -1.0, signal="W_HFM").between(ONSET, 1e9).values("W_HFM") == 0.0).all()


@pytest.mark.parametrize("signal", SENSORS)
def test_the_engine_runs_on_with_a_dead_sensor(signal: str) -> None:
    dead = Fault(name="sensor_stuck", magnitude=-1.0, onset_s=20.0, signal=signal)
    late = simulate_airpath(**SHORT, egr=True, faults=[dead]).between(30.0, 1e9)
    assert np.abs(late.values(signal)).max() < 0.3
    assert 50.0 < late.values("truth.p_Int").min() < late.values("truth.p_Int").max() < 400.0


def test_the_control_unit_believes_its_sensors(healthy: Log) -> None:
    late = slice(70 * 50, None)
    # boost that reads high is lowered, a flow that reads low starves the engine of fuel
    high = faulty("boost_pressure_gain", 0.2)
    assert np.mean(high.values("p_Int")[late]) < np.mean(healthy.values("p_Int")[late]) - 1.0
    low = faulty("maf_gain", -0.5)
    assert np.sum(low.values("W_Fuel")[late]) < 0.97 * np.sum(healthy.values("W_Fuel")[late])


def test_two_faults_at_once() -> None:
    pair = [Fault(name="maf_gain", magnitude=0.1), Fault(name="boost_leak", magnitude=4.0)]
    log = simulate_airpath(**SHORT, faults=pair)
    assert [e.kind for e in log.events] == ["maf_gain", "boost_leak"]
    late = log.between(50.0, 1e9)
    np.testing.assert_allclose(late.values("W_HFM")[::5], 1.1 * late.values("truth.W_HFM"), rtol=1e-6)
    assert late.values("truth.W_LeakBst").max() > 1.0


def test_tolerances_are_drawn_per_seed_and_belong_to_the_healthy_sensor() -> None:
    logs = [simulate_airpath(duration_s=1.0, tolerance=1, seed=seed) for seed in range(40)]
    drawn = np.array([list(log.facts["tolerances"].values()) for log in logs])
    np.testing.assert_allclose(drawn.std(axis=0), [150.0, 150.0, 5e-3, 1.0, 0.02], rtol=0.35)
    log = simulate_airpath(**SHORT, tolerance=2, seed=3)
    np.testing.assert_array_equal(log.values("truth.p_Bst"), log.values("p_Bst")[::5])
    assert simulate_airpath(**SHORT).facts["tolerances"] == {}


def test_noise_can_be_turned_off(healthy: Log) -> None:
    silent = simulate_airpath(**SHORT, noise=0.0)
    ripple = [np.std(np.diff(log.values("W_HFM"), n=2)) for log in (silent, healthy)]
    assert ripple[0] < 0.1 * ripple[1]
    assert np.ptp(silent.values("p_Amb")) == 0.0


def test_overrides_reach_the_plant_and_stand_as_given() -> None:
    log = simulate_airpath(**SHORT, overrides={"T_Amb": 263.0, "p_Amb": 90e3}, seed=5)
    assert np.mean(log.values("T_Amb")) == pytest.approx(263.0, abs=0.01)
    assert np.mean(log.values("p_Amb")) == pytest.approx(90.0, abs=0.01)
    names = [f for kind in _KINDS for f in kind._fields]
    assert len(names) == len(set(names)) == len(PARAMETERS)


def test_all_mistakes_are_listed_together() -> None:
    with pytest.raises(DynoscopeError) as error:
        simulate_airpath(
            cycle="wltc",
            faults=[Fault(name="leak_boost", magnitude=1.0)],
            tolerance=3,
            seed=-1,
            noise=-1.0,
            overrides={"V_Inlet": 1.0, "T_Amb": 20.0},
        )
    for word in ("wltc_3b", "boost_leak", "tolerance 3", "seed -1", "noise -1", "V_Int", "T_Amb is 20"):
        assert word in str(error.value)
    with pytest.raises(DynoscopeError, match="duration 0"):
        simulate_airpath(duration_s=0.0)


def test_wltc_is_plausible(wltc: Log) -> None:
    v = wltc.values
    dp = v("p_Bst") - v("p_Int")
    assert 88 < v("p_Bst").min() < 98
    assert 190 < v("p_Bst").max() < 220
    assert 0.8 < np.median(dp) < 1.2
    assert 4.0 < dp.max() < 8.0
    assert np.corrcoef(v("p_Bst"), v("p_Int"))[0, 1] > 0.999
    assert 25e3 < v("n_Turb").min() < v("n_Turb").max() < 200e3
    assert 950 < v("truth.T_Exh").max() < 1250
    litres = v("W_Fuel").sum() / 50 / 835 / (v("v_Veh").sum() / 3.6 / 50 / 1e5)
    assert 5.0 < litres < 9.0  # per 100 km


def test_us06_is_plausible() -> None:
    v = simulate_airpath(cycle="us06", overrides={"variation": 0.0}).values
    assert 9 < v("W_HFM").min() < 15
    assert 115 < v("W_HFM").max() < 140
    assert 205 < v("p_Bst").max() < 250
    assert v("n_Turb").max() < 200e3
    assert 1.1 < v("lambda").min() < 1.4


def test_egr_is_recirculated_where_it_should_be() -> None:
    log = simulate_airpath(cycle="udds", egr=True)
    share = log.values("truth.W_Egr") / log.values("truth.W_Cyl")
    opened = log.values("u_Egr") > 1.0
    assert 0.5 < opened.mean() < 0.9
    assert 0.2 < np.quantile(share, 0.75) < 0.4
    assert (share < -0.05).mean() < 0.01
    idle = log.values("v_Veh") < 0.1
    assert opened[idle].mean() < 0.1
    assert log.values("T_Int").max() > 340


def residuals(log: Log, reference: tuple[Array, Array] | None = None) -> tuple[Any, float, float]:
    """r_cyl (relative) and r_dp (kPa) against quadratics in (p_Int, n) and (W sqrt(T/300), p_Int), 1 s."""
    s = {k: log.values(k).reshape(-1, 50).mean(axis=1) for k in ("W_HFM", "p_Bst", "p_Int", "T_Int", "n_Eng")}
    calm = np.abs(np.gradient(s["p_Int"]) / s["p_Int"]) < 0.02  # quasi-steady
    p, n, W = s["p_Int"] / 100, s["n_Eng"] / 1000, s["W_HFM"] * np.sqrt(s["T_Int"] / 300) / 50

    X, Y = (np.stack([a**0, a, b, a * a, a * b, b * b], axis=1)[calm] for a, b in ((p, n), (W, p)))
    flow, dp = (s["W_HFM"] * s["T_Int"] / 300)[calm], (s["p_Bst"] - s["p_Int"])[calm]
    if reference is None:
        reference = np.linalg.lstsq(X, flow)[0], np.linalg.lstsq(Y, dp)[0]
    late = np.arange(len(calm))[calm] > 600
    r_cyl = ((flow - X @ reference[0]) / flow)[late]
    return reference, float(np.median(r_cyl)), float(np.median((dp - Y @ reference[1])[late]))


@pytest.mark.parametrize(
    ("name", "magnitude", "cyl", "dp"),
    [
        ("maf_gain", 0.05, 1, -1),
        ("boost_pressure_gain", 0.02, 0, 1),
        ("intake_pressure_gain", 0.02, -1, -1),
        ("boost_leak", 6.0, 1, -1),
        ("intake_leak", 6.0, 1, 0),
    ],
)
def test_faults_show_with_the_signs_of_theory(
    wltc: Log, name: str, magnitude: float, cyl: int, dp: int
) -> None:
    log = simulate_airpath(
        overrides={"variation": 0.0}, seed=1, faults=[Fault(name=name, magnitude=magnitude)]
    )
    reference, base_cyl, base_dp = residuals(wltc)
    assert abs(base_cyl) < 0.003
    assert abs(base_dp) < 0.03
    _, r_cyl, r_dp = residuals(log, reference)
    for value, sign, floor in ((r_cyl, cyl, 0.01), (r_dp, dp, 0.03)):
        assert (np.sign(value) == sign and abs(value) > floor) if sign else abs(value) < floor, (
            name,
            r_cyl,
            r_dp,
        )


def test_faster_than_800_times_real_time(wltc: Log) -> None:
    seconds = []
    for _ in range(3):
        start = time.process_time()
        simulate_airpath(duration_s=600.0)
        seconds.append(time.process_time() - start)
    assert 600.0 / min(seconds) > 800.0
