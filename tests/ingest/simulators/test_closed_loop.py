"""Plant: conservation, convergence, flow directions, and equality with the numpy orifice."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ingest.errors import DynoscopeError
from ingest.physics import AIR, orifice_flow
from ingest.simulators.closed_loop import COLUMNS, NOISE, simulate
from ingest.simulators.cycles import load_cycle, resample_cycle
from ingest.simulators.faults import Fault, fault_inputs
from ingest.simulators.parameters import RATE_HZ, Control, Plant, Sensors
from ingest.simulators.plant import _orifice
from ingest.simulators.vehicle import Vehicle, drive

Array = NDArray[np.float64]
SILENT = Sensors(**{k: 0.0 for k in Sensors._fields if k.startswith("sd_")})


def run(
    cycle: str | Array,
    *,
    egr: bool = False,
    steps: int = 12,
    faults: tuple[Fault, ...] = (),
    sensors: Sensors = SILENT,
    plant: Plant | None = None,
    duration_s: float | None = None,
) -> dict[str, Array]:
    if isinstance(cycle, str):
        speed = resample_cycle(*load_cycle(cycle), RATE_HZ, duration_s)
        trip = drive(speed, RATE_HZ, Vehicle(variation=0.0), 1.2, np.random.default_rng(0))
        cycle = np.column_stack([trip.n_Eng, trip.W_Fuel])
    n = len(cycle)
    return simulate(
        drive=cycle,
        noise=np.random.default_rng(1).standard_normal((n, len(NOISE))),
        faults=fault_inputs(faults, np.arange(n) / RATE_HZ, n / RATE_HZ, np.random.default_rng(2)),
        egr_active=egr,
        plant=plant or Plant(),
        control=Control(),
        sensors=sensors,
        steps=steps,
    )


def imbalance(r: dict[str, Array]) -> dict[str, float]:
    """Net inflow minus growth of the stored mass, as a share of all air, for every volume."""
    total = {k: float(np.trapezoid(r[k], dx=1 / RATE_HZ)) for k in COLUMNS}
    grown = {k: float(r[k][-1] - r[k][0]) for k in COLUMNS}
    t = total
    lost = {
        "boost": t["W_Comp"] - t["W_Thr"] - t["W_LeakBst"] - grown["m_Bst"],
        "intake": t["W_Thr"] + t["W_Egr"] - t["W_Cyl"] - t["W_LeakInt"] - grown["m_Air"] - grown["m_Egr"],
        "exhaust": t["W_Cyl"] + t["W_Fuel"] - t["W_Turb"] - t["W_Egr"] - grown["m_Exh"],
    }
    return {k: v / t["W_Comp"] for k, v in lost.items()} | {"all": sum(lost.values()) / t["W_Comp"]}


@pytest.mark.parametrize("egr", [False, True])
@pytest.mark.parametrize("cycle", ["us06", "udds"])
def test_mass_is_conserved_over_a_cycle(cycle: str, egr: bool) -> None:
    leaks = Fault(name="boost_leak", magnitude=6), Fault(name="intake_leak", magnitude=4)
    r = run(cycle, egr=egr, faults=leaks, sensors=Sensors())
    assert (np.abs(r["W_Egr"]).max() > 5e-3) == egr
    assert max(map(abs, imbalance(r).values())) < 1e-4


def test_the_balance_notices_a_volume_that_is_too_stiff_for_the_step() -> None:
    stiff = Plant(V_Int=2.5e-3, Pi_lin_Thr=0.996)
    assert abs(imbalance(run("us06", plant=stiff, duration_s=120.0))["boost"]) > 1e-3


@pytest.mark.parametrize("egr", [False, True])
def test_half_the_step_gives_the_same_pressures(egr: bool) -> None:
    one, half = (run("us06", egr=egr, steps=steps) for steps in (12, 24))
    for p in ("p_Bst", "p_Int", "read.p_Exh"):
        assert np.abs(one[p] - half[p]).max() < 0.6  # Pa
    assert np.abs(one["read.W_HFM"] - half["read.W_HFM"]).max() < 1e-6  # kg/s


def test_at_rest_powers_and_flows_balance() -> None:
    r = run(np.tile([2000.0, 2.4e-3], (1500, 1)))
    last = {k: v[-1] for k, v in r.items()}
    assert last["W_Comp"] == pytest.approx(last["W_Thr"], rel=1e-6)
    assert last["W_Turb"] == pytest.approx(last["W_Cyl"] + last["W_Fuel"], rel=1e-6)
    assert last["p_Bst"] == pytest.approx(last["read.p_Bst"], rel=1e-6)
    T_Int = last["p_Int"] * Plant().V_Int / (last["m_Air"] * AIR.R)
    f_vol = last["W_Cyl"] * 120 / 2000.0 / Plant().V_eng * AIR.R * T_Int / last["p_Int"]
    assert 0.85 < f_vol < 0.95


@given(
    p=st.floats(5e4, 4e5),
    q=st.floats(5e4, 4e5),
    T=st.floats(250, 900),
    U=st.floats(250, 900),
    lin=st.floats(0.9, 0.995),
)
def test_compiled_orifice_is_the_numpy_one(p: float, q: float, T: float, U: float, lin: float) -> None:
    expected = float(orifice_flow(1e-4, p, T, q, T_dn=U, Pi_lin=lin))
    assert _orifice(1e-4, p, T, q, U, True, lin) == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("fault", "flow", "p"), [("boost_leak", "W_LeakBst", "p_Bst"), ("intake_leak", "W_LeakInt", "p_Int")]
)
def test_a_leak_flows_inwards_below_ambient_pressure(fault: str, flow: str, p: str) -> None:
    r = run("wltc_3b", faults=(Fault(name=fault, magnitude=6.0, onset_s=0.0),), duration_s=400.0)
    inside = r[p] - Plant().p_Amb
    assert (inside < -1e3).any()
    assert (inside > 1e4).any()
    clear = np.abs(inside) > 1.0
    np.testing.assert_array_equal(np.sign(r[flow][clear]), np.sign(inside[clear]))


def test_oxygen_of_the_intake_is_that_of_air_and_falls_with_egr() -> None:
    for egr in (False, True):
        r = run("us06", egr=egr, duration_s=200.0)
        rO2 = r["m_O2"] / (r["m_Air"] + r["m_Egr"])
        assert rO2.max() == pytest.approx(0.2314, rel=1e-3)
        assert (rO2.min() < 0.21) == egr


def test_parameters_that_no_engine_survives_are_reported() -> None:
    with pytest.raises(DynoscopeError, match="physical range"):
        run("us06", plant=Plant(V_Int=0.0), duration_s=20.0)


def test_columns_are_filled_where_they_are_named() -> None:
    stuck = Fault(name="egr_stuck_open", magnitude=40.0)  # from a third of the run on
    r = run("us06", egr=True, duration_s=300.0, faults=(stuck,))
    assert set(r) == set(COLUMNS)
    np.testing.assert_allclose(r["x_Egr"][5100:], 0.4)
    np.testing.assert_allclose(r["x_Egr"][:5000], r["u_Egr"][:5000], atol=1e-12)
    np.testing.assert_allclose(r["read.W_HFM"], r["healthy.W_HFM"])
    T_Int = r["p_Int"] * Plant().V_Int / ((r["m_Air"] + r["m_Egr"]) * AIR.R)
    assert np.abs(r["read.T_Int"] - T_Int).mean() < 8.0
    np.testing.assert_allclose(r["read.p_Bst"].mean(), r["p_Bst"].mean(), rtol=0.01)
    assert 2.5e4 < r["w_Turb"].max() * 30 / np.pi < 2e5
