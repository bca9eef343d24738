"""Vehicle and driver: a speed trace becomes gear, engine speed and demanded fuel (backward, quasi-static)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ingest.simulators.parameters import Q_LHV

__all__ = ["Drive", "Vehicle", "drive"]

Array = NDArray[np.float64]


class Vehicle(NamedTuple):
    """A light van with a 2.2 l diesel engine and six gears; SI units where the name has none."""

    mass: float = 2050.0  # kg
    CdA: float = 0.86  # m2
    rolling: float = 0.011  # rolling resistance coefficient
    wheel_radius: float = 0.34  # m
    final_drive: float = 3.6
    gear_1: float = 3.9
    gear_2: float = 2.15
    gear_3: float = 1.38
    gear_4: float = 0.99
    gear_5: float = 0.77
    gear_6: float = 0.62
    eta_driveline: float = 0.92
    n_idle: float = 720.0  # rpm
    n_launch: float = 1150.0  # rpm, while the clutch slips
    n_shift: float = 1900.0  # rpm, above which the next gear is used without load
    n_shift_load: float = 1700.0  # rpm on top of it at full power
    n_hold: float = 0.8  # share of that limit below which the lower gear is taken
    P_max: float = 1.1e5  # W
    P_aux: float = 600.0  # W
    eta_willans: float = 0.44
    friction_0: float = 21.0  # friction torque, Nm
    friction_n: float = 4.9e-3  # Nm per rpm
    shift_cut_s: float = 0.45
    wander: float = 0.12  # m/s, how far the driver strays from the cycle (standard deviation)
    variation: float = 1.0  # scale of everything that differs between drives; 0: every seed drives the same


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """What the plant gets from the vehicle, each of shape (n,)."""

    v: Array  # m/s
    n_Eng: Array  # rpm
    W_Fuel: Array  # demanded, kg/s


def drive(speed: Array, rate_hz: float, vehicle: Vehicle, rho: float, rng: np.random.Generator) -> Drive:
    """Follows ``speed`` (m/s at ``rate_hz``) in air of density ``rho`` (kg/m3).

    Tractive force ``m dv/dt + c_r m g + rho/2 CdA v^2``; fuel by the Willans line
    ``W_Fuel = (P_brake + P_friction)/(eta Q_LHV)``, cut to zero in overrun and during a shift.
    """
    v = _follow(speed, rate_hz, vehicle, rng)
    force = vehicle.mass * np.gradient(v) * rate_hz + 0.5 * rho * vehicle.CdA * v**2
    force += np.where(v > 0.1, vehicle.rolling * vehicle.mass * 9.81, 0.0)
    P_wheel = force * v
    eta = vehicle.eta_driveline
    P_brake = np.where(P_wheel > 0, P_wheel / eta, P_wheel * eta)
    ratio, shifting = _gears(v, P_brake, rate_hz, vehicle)
    n = np.maximum(v * ratio, np.where((v > 0.3) & (P_brake > 0), vehicle.n_launch, vehicle.n_idle))
    n = _smooth(n, 0.5, rate_hz)
    P_friction = (vehicle.friction_0 + vehicle.friction_n * n) * n * np.pi / 30.0 + vehicle.P_aux
    declutched = shifting | (v * ratio < vehicle.n_idle)
    P_brake = np.where(declutched, np.maximum(P_brake, 0.0), P_brake)  # no engine braking then
    P_total = np.clip(P_brake, -np.inf, vehicle.P_max) + P_friction
    W_Fuel = np.where(shifting, 0.0, np.maximum(P_total, 0.0)) / (vehicle.eta_willans * Q_LHV)
    return Drive(v=v, n_Eng=n, W_Fuel=_smooth(W_Fuel, 0.2, rate_hz))


def _follow(speed: Array, rate_hz: float, vehicle: Vehicle, rng: np.random.Generator) -> Array:
    """The driver's speed: the trace rounded off, plus slow straying that vanishes at standstill."""
    stray = _smooth(rng.standard_normal(len(speed)), 8.0, rate_hz)
    stray *= vehicle.variation * vehicle.wander * np.sqrt(8.0 * rate_hz * 2.0 / 3.0)
    v = _smooth(speed, 1.6, rate_hz)
    return np.maximum(v + stray * np.minimum(v / 5.0, 1.0), 0.0)


def _gears(v: Array, P_brake: Array, rate_hz: float, vehicle: Vehicle) -> tuple[Array, NDArray[np.bool_]]:
    """Engine rpm per m/s of the gear in use and whether a shift is under way, both of shape (n,).

    Twice a second: up where the engine turns faster than a limit that rises with power, down where it would
    stay well below that limit; one step at a time, not more often than once a second.
    """
    gears = np.array([getattr(vehicle, f"gear_{i}") for i in range(1, 7)])
    ratios = gears * vehicle.final_drive / vehicle.wheel_radius * 30.0 / np.pi
    step = max(1, round(rate_hz / 2))
    power = np.clip(_smooth(P_brake, 2.0, rate_hz)[::step] / vehicle.P_max, 0.0, 1.0)
    n_up = vehicle.n_shift + vehicle.n_shift_load * power
    up = (v[::step, None] * ratios[:-1] > n_up[:, None]).sum(axis=1)
    down = (v[::step, None] * ratios[:-1] > vehicle.n_hold * n_up[:, None]).sum(axis=1)
    used, gear, last = np.empty_like(up), int(up[0]), -2
    for i, (low, high) in enumerate(zip(up.tolist(), down.tolist(), strict=True)):
        target = min(max(gear, low), high)
        if target != gear and i - last >= 2:
            gear, last = gear + (1 if target > gear else -1), i
        used[i] = gear
    index = np.repeat(used, step)[: len(v)]
    starts = np.flatnonzero(np.diff(index)) + 1
    shifting = np.zeros(len(v), dtype=np.bool_)
    for start in starts.tolist():
        shifting[start : start + round(vehicle.shift_cut_s * rate_hz)] = v[start] > 0.5
    return ratios[index], shifting


def _smooth(x: Array, window_s: float, rate_hz: float) -> Array:
    """Moving average with a Hann window of ``window_s``; the ends are continued."""
    half = max(1, round(window_s * rate_hz / 2))
    w = np.hanning(2 * half + 1)
    return np.convolve(np.pad(x, half, mode="edge"), w / w.sum(), mode="valid")
