"""The electronic throttle with its position sensor (dissertation, 3.3): a drive and faults in, a log out.

Plant (3.15) with the sign of ``N K_t / J`` that makes it stable, J = N^2 J_m + J_g, K_f = N^2 b_m + b_t:

    J theta'' = -K_sp theta - K_f theta' + N K_t i_a        L_a i_a' = e_a - R_a i_a - N K_b theta'

and a first-order sensor, with process disturbance ``w_p`` before and measurement noise ``w_n`` after it:

    tau_TPS y' + y = k_TPS (theta + w_p)                    theta_ang = y + w_n

Parameters are constant over ``SEGMENT`` samples and the states carried over; within one, the zero-order-hold
discretisation is exact. Parameters of the plant: Bosch DV-E5 of Loh, Thanom, Pyko and Lee (Engineering 5,
2013, 587-600), poles at 1.03 ms, 29.1 ms, 1.29 s; those of the sensor and of the noise are choices.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import DynoscopeError, did_you_mean
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.physics import zero_order_hold
from ingest.simulators.faults import FAULT_FREE, Fault

__all__ = ["FAULTS", "Throttle", "plant_coefficients", "simulate_throttle"]

Array = NDArray[np.float64]

DT = 1e-4
SEGMENT = 100  # samples with the same parameters: 10 ms
CONTROL = 10  # samples between two actions of the controller: 1 ms
STREAMS = ("pedal", "w_p", "w_n")


class Throttle(NamedTuple):
    """Parameters, SI units. ``closed_loop`` 0: the controller reads a noise-free twin, so that the voltage is
    independent of the noise; 1: it reads the sensor."""

    N: float = 20.0
    J_m: float = 3.2e-6
    J_g: float = 2.1e-3
    b_m: float = 2.05e-5
    b_t: float = 2.05e-5
    K_b: float = 0.02
    K_t: float = 0.02
    R_a: float = 1.5
    L_a: float = 1.5e-3
    K_sp: float = 0.087
    tau_TPS: float = 2e-4
    k_TPS: float = 2.5
    sd_w_p: float = 2e-3  # rad
    tau_w_p: float = 0.0  # s; the disturbance is white where it is 0, else an AR(1) of the same spread
    sd_w_n: float = 1e-3  # V
    closed_loop: float = 0.0
    pedal_min: float = 0.1  # rad
    pedal_max: float = 1.2
    pedal_hold: float = 0.25  # s, mean time between two movements
    pedal_tau: float = 0.02  # s, of a movement
    K_P: float = 25.0  # V/rad
    K_I: float = 30.0
    K_D: float = 0.5
    e_a_max: float = 12.0


# the named faults: which parameter drifts; any other varying parameter is a fault by its own name
FAULTS = {
    "tps_time_constant": "tau_TPS",
    "tps_gain": "k_TPS",
    "motor_torque_constant": "K_t",
    "back_emf_constant": "K_b",
}
VARYING = Throttle._fields[: Throttle._fields.index("sd_w_n") + 1]
SENSOR = ("tps_time_constant", "tps_gain", "tau_TPS", "k_TPS", "sd_w_n")


def plant_coefficients(p: Throttle) -> tuple[float, float, float, float]:
    """``k_ET, a_1, a_2, a_3`` of (3.17), in 1/s^3, 1/s, 1/s^2, 1/s^3.

    >>> [float(f"{c:.4g}") for c in plant_coefficients(Throttle())]
    [78900.0, 1002.0, 34020.0, 25740.0]
    """
    J, K_f = p.N**2 * p.J_m + p.J_g, p.N**2 * p.b_m + p.b_t
    scale = 1.0 / (J * p.L_a)
    return (
        p.N * p.K_t * scale,
        (J * p.R_a + K_f * p.L_a) * scale,
        (K_f * p.R_a + p.N**2 * p.K_b * p.K_t + p.K_sp * p.L_a) * scale,
        p.K_sp * p.R_a * scale,
    )


def simulate_throttle(
    *,
    faults: Sequence[Fault] = (),
    seed: int = 0,
    duration_s: float = 50.0,
    noise: float = 1.0,
    overrides: Mapping[str, float] = {},
    name: str | None = None,
) -> Log:
    """A log of the throttle in normal operation, with ``faults`` and ground truth.

    Group ``throttle`` (10 kHz): motor voltage ``e_a`` and sensor output ``theta_ang``, V. Group ``truth``:
    ``truth.theta_ang``, the noise-free reading of a healthy sensor, and ``truth.theta``, rad. The pedal moves
    to a random level at random times; a PID controller follows at 1 kHz within the voltage limits.

    A fault multiplies a parameter by ``1 + magnitude`` (at the end of its ramp): one of ``FAULTS``, or any
    varying parameter by its own name. A fault does not shift the noise.

    Raises:
        DynoscopeError: names or values that cannot be used (all listed).
    """
    if problems := list(_problems(faults, seed, duration_s, noise, overrides)):
        raise DynoscopeError("throttle simulation: " + "; ".join(problems))
    nominal = Throttle(**overrides)
    samples = SEGMENT * round(duration_s / (SEGMENT * DT))
    time: Array = DT * np.arange(samples, dtype=np.float64)
    varying = _varying(nominal, faults, time[::SEGMENT], samples * DT)
    rng = {purpose: np.random.default_rng([seed, i]) for i, purpose in enumerate(STREAMS)}
    sd_p, sd_n = (np.repeat(varying[:, VARYING.index(n)], SEGMENT) for n in ("sd_w_p", "sd_w_n"))
    w_p = sd_p * _coloured(rng["w_p"].standard_normal(samples), nominal.tau_w_p)
    w_n = noise * sd_n * rng["w_n"].standard_normal(samples)
    pedal = _pedal(nominal, samples, rng["pedal"])
    e_a, theta, reading, healthy = _run(nominal, varying, pedal, w_p, w_n)
    groups = {
        "throttle": _group("throttle", time, {"e_a": (e_a, "V"), "theta_ang": (reading, "V")}),
        "truth": _group("truth", time, {"truth.theta_ang": (healthy, "V"), "truth.theta": (theta, "rad")}),
    }
    events = tuple(_event(fault, samples * DT) for fault in faults) or (FAULT_FREE,)
    facts = {
        "simulator": "throttle", "vehicle": "electronic throttle, simulated", "duration_s": samples * DT,
        "seed": seed, "noise": noise, "overrides": dict(overrides), "faults": [asdict(f) for f in faults],
    }  # fmt: skip
    return Log(name or f"throttle_{seed}", groups, events, facts)


def _problems(
    faults: Sequence[Fault], seed: int, duration_s: float, noise: float, overrides: Mapping[str, float]
) -> Iterator[str]:
    """What is wrong with a call, one sentence each."""
    known = {*FAULTS, *VARYING}
    for fault in faults:
        if fault.name not in known:
            yield f"unknown fault {fault.name!r}; {did_you_mean(fault.name, known)}"
        if not (math.isfinite(fault.magnitude) and -1.0 < fault.magnitude <= 10.0):
            yield f"fault {fault.name}: magnitude {fault.magnitude:g}; expected above -1, at most 10"
        if not (0.0 <= fault.starts(duration_s) < duration_s and fault.ramp_s >= 0.0):
            yield f"fault {fault.name}: onset and ramp must lie within the log, 0 … {duration_s:g} s"
        if fault.signal is not None:
            yield f"fault {fault.name}: signal {fault.signal!r} is not part of it; leave it out"
    if seed < 0:
        yield f"seed {seed}; expected 0 or more"
    if not SEGMENT * DT <= duration_s <= 3600.0:
        yield f"duration {duration_s:g} s; expected {SEGMENT * DT:g} … 3600 s"
    if not 0.0 <= noise < math.inf:
        yield f"noise {noise:g}; expected 0 or more"
    for key, value in overrides.items():
        if key not in Throttle._fields:
            yield f"unknown parameter {key!r}; {did_you_mean(key, Throttle._fields)}"
        elif not (math.isfinite(value) and value >= 0.0):
            yield f"{key} = {value:g}; expected 0 or more"
        elif value == 0.0 and key in (
            "J_g",
            "R_a",
            "L_a",
            "tau_TPS",
            "k_TPS",
            "K_t",
            "pedal_hold",
            "pedal_tau",
        ):
            yield f"{key} = 0; expected more than 0"


def _varying(p: Throttle, faults: Sequence[Fault], time: Array, duration_s: float) -> Array:
    """The varying parameters of each segment, shape (segments, len(VARYING))."""
    values = np.tile(np.array([getattr(p, n) for n in VARYING]), (len(time), 1))
    for fault in faults:
        factor = 1.0 + fault.magnitude * fault.severity(time, duration_s)
        values[:, VARYING.index(FAULTS.get(fault.name, fault.name))] *= factor
    return values


def _coloured(white: Array, tau: float) -> Array:
    """An AR(1) of time constant ``tau`` and the variance of ``white``."""
    from scipy.signal import lfilter

    a = math.exp(-DT / tau) if tau > 0.0 else 0.0
    coloured: Array = lfilter([math.sqrt(1.0 - a * a)], [1.0, -a], white)
    return coloured


def _pedal(p: Throttle, samples: int, rng: np.random.Generator) -> Array:
    """Wanted angle at every action of the controller, rad: levels held for exponential times, smoothed."""
    from scipy.signal import lfilter

    actions = -(-samples // CONTROL)
    count = int(samples * DT / p.pedal_hold * 2) + 20
    edges = np.cumsum(np.maximum(rng.exponential(p.pedal_hold, count), CONTROL * DT))
    levels = rng.uniform(p.pedal_min, p.pedal_max, count)
    steps = levels[np.minimum(np.searchsorted(edges, CONTROL * DT * np.arange(actions)), count - 1)]
    a = math.exp(-CONTROL * DT / p.pedal_tau)
    smooth: Array = lfilter([1.0 - a], [1.0, -a], steps)
    return smooth


def _run(
    p: Throttle, varying: Array, pedal: Array, w_p: Array, w_n: Array
) -> tuple[Array, Array, Array, Array]:
    """Voltage, angle, reading, and the healthy sensor's noise-free reading, one value a sample."""
    from ingest.simulators.throttle_loop import simulate

    distinct, which = np.unique(varying, axis=0, return_inverse=True)
    Ad, Bd = _discretised(p, [p._replace(**dict(zip(VARYING, row, strict=True))) for row in distinct])
    gains = np.array([p.K_P, p.K_I, p.K_D, p.e_a_max, p.k_TPS, p.closed_loop])
    out = simulate(Ad, Bd, which.ravel(), SEGMENT, CONTROL, CONTROL * DT, gains, pedal, w_p, w_n)
    return out[0], out[1], out[2], out[3]


def _discretised(nominal: Throttle, segments: Sequence[Throttle]) -> tuple[Array, Array]:
    """Exact discretisation of states (theta, theta', i_a, y, healthy y), inputs (e_a, w_p), each segment."""
    A, B = np.zeros((len(segments), 5, 5)), np.zeros((len(segments), 5, 2))
    for a, b, p in zip(A, B, segments, strict=True):
        J, K_f = p.N**2 * p.J_m + p.J_g, p.N**2 * p.b_m + p.b_t
        a[0, 1] = 1.0
        a[1, :3] = -p.K_sp / J, -K_f / J, p.N * p.K_t / J
        a[2, 1:3], b[2, 0] = (-p.N * p.K_b / p.L_a, -p.R_a / p.L_a), 1.0 / p.L_a
        for row, sensor in ((3, p), (4, nominal)):
            a[row, 0] = b[row, 1] = sensor.k_TPS / sensor.tau_TPS
            a[row, row] = -1.0 / sensor.tau_TPS
    return zero_order_hold(A, B, DT)


def _group(name: str, time: Array, columns: Mapping[str, tuple[Array, str]]) -> Group:
    frame = {TIME: time, **{k: v.astype(np.float32) for k, (v, _) in columns.items()}}
    return Group(name, pl.DataFrame(frame), {k: Signal(name=k, unit=u) for k, (_, u) in columns.items()})


def _event(fault: Fault, duration_s: float) -> Event:
    return Event(
        t_start=fault.starts(duration_s), t_end=fault.end_s, kind=fault.name, source="truth",
        channel="theta_ang" if fault.name in SENSOR else None, magnitude=fault.magnitude, unit="1",
    )  # fmt: skip
