"""Orifice flow against isentropic nozzle theory and its own limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from ingest.physics import AIR, EXHAUST, Gas, critical_ratio, flow_function, orifice_flow

GASES = [AIR, EXHAUST]
LINEAR = [0.96, 0.99]


def phi(Pi: float, gas: Gas, lin: float) -> float:
    return float(flow_function(Pi, gas.kappa, critical_ratio(gas.kappa), lin))


@pytest.mark.parametrize("gas", GASES)
@pytest.mark.parametrize("lin", LINEAR)
def test_flow_function_is_continuous(gas: Gas, lin: float) -> None:
    for border in (critical_ratio(gas.kappa), lin, 1.0):
        below, above = border * (1 - 1e-15), min(border * (1 + 1e-15), 1.0)
        assert abs(phi(below, gas, lin) - phi(above, gas, lin)) < 1e-12
    assert phi(1.0, gas, lin) == 0.0


@pytest.mark.parametrize("gas", GASES)
def test_choking_is_where_the_mass_flow_of_a_nozzle_peaks(gas: Gas) -> None:
    def flow(Pi: float) -> float:  # density times velocity of an isentropic expansion, in units p/sqrt(RT)
        velocity = np.sqrt(2 * gas.kappa / (gas.kappa - 1) * (1 - Pi ** ((gas.kappa - 1) / gas.kappa)))
        return float(Pi ** (1 / gas.kappa) * velocity)

    peak = minimize_scalar(lambda Pi: -flow(Pi), bounds=(0.3, 0.8), method="bounded", options={"xatol": 1e-9})
    assert critical_ratio(gas.kappa) == pytest.approx(peak.x, abs=1e-6)
    assert phi(0.1, gas, 0.99) == pytest.approx(flow(peak.x), rel=1e-9)
    assert phi(0.8, gas, 0.99) == pytest.approx(flow(0.8), rel=1e-12)


@given(a=st.floats(0.0, 1.0), b=st.floats(0.0, 1.0), lin=st.sampled_from(LINEAR))
def test_flow_function_never_rises_with_the_ratio(a: float, b: float, lin: float) -> None:
    low, high = sorted((a, b))
    assert phi(low, AIR, lin) >= phi(high, AIR, lin) - 1e-12


@given(p=st.floats(2e4, 5e5), q=st.floats(2e4, 5e5), T=st.floats(230, 1300), U=st.floats(230, 1300))
def test_flow_reverses_with_the_pressures(p: float, q: float, T: float, U: float) -> None:
    forward = float(orifice_flow(1e-5, p, T, q, T_dn=U))
    assert forward == -float(orifice_flow(1e-5, q, U, p, T_dn=T)) or p == q
    assert np.sign(forward) == np.sign(p - q)


def test_printed_examples_of_a_leak() -> None:
    hole = 0.65 * np.pi / 4 * np.array([5e-3, 5e-3]) ** 2
    W = orifice_flow(hole, np.array([160e3, 100e3]), 320.0, 101.3e3, T_dn=293.0) * 1e3
    assert W[0] == pytest.approx(4.44, abs=0.1)
    assert W[1] < -0.3  # below ambient the air enters
