"""Vehicle: fuel and engine speed against hand calculation."""

from __future__ import annotations

import numpy as np
import pytest

from ingest.simulators.parameters import Q_LHV
from ingest.simulators.vehicle import Drive, Vehicle, drive

CALM = Vehicle(variation=0.0)
RHO = 1.2


def follow(
    speed: np.ndarray[tuple[int], np.dtype[np.float64]], vehicle: Vehicle = CALM, seed: int = 0
) -> Drive:
    return drive(speed, 50.0, vehicle, RHO, np.random.default_rng(seed))


def test_constant_speed_needs_the_fuel_of_the_willans_line() -> None:
    v = 30.0
    steady = follow(np.full(3000, v))
    n, W_Fuel = steady.n_Eng[1500], steady.W_Fuel[1500]
    ratio = CALM.gear_6 * CALM.final_drive / CALM.wheel_radius
    assert n == pytest.approx(v * ratio * 30 / np.pi)
    P_road = (CALM.rolling * CALM.mass * 9.81 + 0.5 * RHO * CALM.CdA * v**2) * v / CALM.eta_driveline
    P_friction = (CALM.friction_0 + CALM.friction_n * n) * n * np.pi / 30 + CALM.P_aux
    assert W_Fuel == pytest.approx((P_road + P_friction) / (CALM.eta_willans * Q_LHV))


def test_standstill_idles_and_overrun_is_cut() -> None:
    speed = np.interp(np.arange(3000) / 50.0, [0, 10, 30, 60], [30, 30, 0, 0])
    slowing = follow(speed)
    assert (slowing.W_Fuel[750:1000] == 0.0).all()
    assert slowing.n_Eng[-1] == pytest.approx(CALM.n_idle)
    assert 5e-5 < slowing.W_Fuel[-1] < 3e-4


def test_gears_keep_the_engine_in_its_range_and_do_not_hunt() -> None:
    t = np.arange(6000) / 50.0
    up = follow(np.minimum(t * 0.6, 36.0))
    ratio = up.n_Eng[up.v > 8] / up.v[up.v > 8]
    assert up.n_Eng.max() < 3500
    assert (np.diff(ratio) <= 1e-6 * ratio[1:]).mean() > 0.99  # upwards only
    assert up.n_Eng[-1] / up.v[-1] == pytest.approx(
        CALM.gear_6 * CALM.final_drive / CALM.wheel_radius * 30 / np.pi
    )


def test_every_seed_is_another_drive_unless_variation_is_off() -> None:
    speed = np.full(3000, 20.0)
    stray = follow(speed, Vehicle(), 1).v - follow(speed, Vehicle(), 2).v
    assert 0.02 < np.std(stray) < 0.5
    np.testing.assert_array_equal(follow(speed, CALM, 1).v, follow(speed, CALM, 2).v)
