"""The air-path simulator's front: a drive cycle and faults in, a log with ground truth out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ingest.errors import DynoscopeError, LogError, did_you_mean
from ingest.log import Log
from ingest.physics import AIR
from ingest.simulators.cycles import load_cycle, resample_cycle
from ingest.simulators.faults import Fault, fault_inputs, fault_problems, truth_events
from ingest.simulators.parameters import RATE_HZ, Control, Plant, Sensors
from ingest.simulators.signals import ECU, TRUTH, group
from ingest.simulators.vehicle import Vehicle, drive

__all__ = ["Fault", "simulate_airpath"]

Array = NDArray[np.float64]
T = TypeVar("T", Vehicle, Plant, Control, Sensors)

TRUTH_EVERY = 5  # samples: 10 Hz
LAMBDA_MAX = 10.0  # where the sensor's range ends

# spread between drives (standard deviation): payload, wind, weather, coolant
VARIATION = {"mass": 60.0, "CdA": 0.02, "T_Amb": 4.0, "p_Amb": 600.0, "T_coolant": 2.0}
# spread between engines: sensors and the throttle's pressure loss, by tolerance level
_COMMON = {"gain_HFM": 5e-3, "offset_T_Int": 1.0, "dp_scale": 0.02}
TOLERANCES: dict[int, dict[str, float]] = {
    0: {},
    1: {"offset_p_Bst": 150.0, "offset_p_Int": 150.0, **_COMMON},
    2: {"offset_p_Bst": 30.0, "offset_p_Int": 30.0, **_COMMON},
}

_KINDS = (Vehicle, Plant, Control, Sensors)
PARAMETERS: dict[str, float] = {k: v for kind in _KINDS for k, v in kind._field_defaults.items()}
STREAMS = ("variation", "tolerance", "driver", "sensors", "logging", "faults")


def simulate_airpath(
    *,
    cycle: str | Path = "wltc_3b",
    faults: Sequence[Fault] = (),
    tolerance: int = 0,
    egr: bool = False,
    seed: int = 0,
    duration_s: float | None = None,
    noise: float = 1.0,
    overrides: Mapping[str, float] = {},
    name: str | None = None,
) -> Log:
    """A log of a diesel car on ``cycle`` with ``faults`` and ground truth.

    Group ``ecu`` (50 Hz) holds what the sensors say, group ``truth`` (10 Hz, at sample times of ``ecu``)
    what healthy sensors would have said with the same noise and lag, and the true flows. Each fault is an
    event with source ``truth``; without any there is one of kind ``none``. A fault does not shift the
    noise: up to its onset the log is that of the same seed without it. Every seed is another drive
    (payload, weather, driver), unless ``overrides`` has variation 0.

    Args:
        cycle: a name of ``cycles.CYCLES`` or a CSV file of time and speed.
        tolerance: 0 none, 1 sensor tolerances drawn per seed, 2 the same with pressures zeroed at key-on.
        egr: recirculate exhaust gas; otherwise the valve is commanded shut.
        duration_s: cuts or repeats the cycle.
        noise: scale of all sensor noise.
        overrides: parameters of the plant, control unit, sensors or vehicle by name, SI units.

    Raises:
        DynoscopeError: names, ranges or a cycle that cannot be used (all listed), or values with which the
            engine leaves its physical range.
    """
    from ingest.simulators.closed_loop import NOISE, simulate  # loads the compiler

    speed = _checked_speed(cycle, faults, tolerance, seed, duration_s, noise, overrides)
    rng = {purpose: np.random.default_rng([seed, i]) for i, purpose in enumerate(STREAMS)}
    varied = _draw(VARIATION, overrides.get("variation", 1.0), rng["variation"])
    tolerances = _draw(TOLERANCES[tolerance], 1.0, rng["tolerance"])
    vehicle, plant, control, sensors = _parameters(varied, tolerances, overrides, noise)

    time = np.arange(len(speed)) / RATE_HZ
    trip = drive(speed, RATE_HZ, vehicle, plant.p_Amb / (AIR.R * plant.T_Amb), rng["driver"])
    run = simulate(
        drive=np.column_stack([trip.n_Eng, trip.W_Fuel]),
        noise=rng["sensors"].standard_normal((len(time), len(NOISE))),
        faults=fault_inputs(faults, time, len(speed) / RATE_HZ, rng["faults"]),
        egr_active=egr,
        plant=plant,
        control=control,
        sensors=sensors,
    )
    constant = {"p_Amb": plant.p_Amb, "T_Amb": plant.T_Amb, "theta_Thr": 100.0}
    run |= {key: np.full_like(time, value) for key, value in constant.items()}
    run |= {
        "v_Veh": trip.v,
        "n_Turb": run["w_Turb"] * 30.0 / np.pi,
        "lambda": 1.0 / np.maximum(run["read.1/lambda"], 1.0 / LAMBDA_MAX),
    }
    some = {key: values[::TRUTH_EVERY] for key, values in run.items()}
    groups = {
        "ecu": group("ecu", ECU, run, time, rng["logging"], noise),
        "truth": group("truth", TRUTH, some, time[::TRUTH_EVERY]),
    }
    facts = {
        "simulator": "airpath",
        "vehicle": "2.2 l diesel van, simulated",
        "cycle": str(cycle),
        "duration_s": len(speed) / RATE_HZ,
        "seed": seed,
        "tolerance": tolerance,
        "egr": egr,
        "noise": noise,
        "overrides": dict(overrides),
        "variation": varied,
        "tolerances": tolerances,
        "faults": [asdict(f) for f in faults],
    }
    events = truth_events(faults, len(speed) / RATE_HZ)
    return Log(name or f"airpath_{Path(cycle).stem}_{seed}", groups, events, facts)


def _checked_speed(
    cycle: str | Path,
    faults: Sequence[Fault],
    tolerance: int,
    seed: int,
    duration_s: float | None,
    noise: float,
    overrides: Mapping[str, float],
) -> Array:
    """The speed trace in m/s at 50 Hz, if the call as a whole makes sense."""
    problems, speed = [], np.zeros(0)
    if tolerance not in TOLERANCES:
        problems.append(f"tolerance {tolerance}; expected one of {', '.join(map(str, TOLERANCES))}")
    if seed < 0:
        problems.append(f"seed {seed}; expected 0 or more")
    if not 0.0 <= noise < math.inf:
        problems.append(f"noise {noise:g}; expected 0 (none) or more")
    for key, value in overrides.items():
        if key not in PARAMETERS:
            problems.append(f"unknown parameter {key!r}; {did_you_mean(key, PARAMETERS)}")
        elif not _plausible(value, PARAMETERS[key]):
            problems.append(
                f"parameter {key} is {value:g}; expected 0, or 0.1 to 10 times {PARAMETERS[key]:g}"
            )
    if duration_s is not None and not 1.0 <= duration_s < math.inf:
        problems.append(f"duration {duration_s:g} s; expected 1 s or more")
    else:
        try:
            speed = resample_cycle(*load_cycle(cycle), RATE_HZ, duration_s)
        except LogError as error:
            problems.append(str(error))
    problems += fault_problems(faults, len(speed) / RATE_HZ if len(speed) else math.inf)
    if problems:
        raise DynoscopeError("\n".join(problems))
    return speed


def _plausible(value: float, default: float) -> bool:
    """Whether unit and sign can be right: 20 is no temperature in K, 100 no pressure in Pa."""
    return math.isfinite(value) and (value == 0.0 or default == 0.0 or 0.1 <= value / default <= 10.0)


def _draw(spread: Mapping[str, float], scale: float, rng: np.random.Generator) -> dict[str, float]:
    """One normal deviate per name with the given standard deviations."""
    return {key: float(scale * sd * rng.standard_normal()) for key, sd in spread.items()}


def _parameters(
    varied: Mapping[str, float], tolerances: Mapping[str, float], overrides: Mapping[str, float], noise: float
) -> tuple[Vehicle, Plant, Control, Sensors]:
    """Defaults, shifted by what was drawn; what the user gives stands as it is."""
    values = dict(PARAMETERS)
    for key, shift in {**varied, **tolerances}.items():
        if key == "dp_scale":  # dp goes with 1/A^2
            values["A_Thr"] /= math.sqrt(1.0 + shift)
        else:
            values[key] += shift
    values |= overrides
    values |= {key: noise * value for key, value in values.items() if key.startswith("sd_")}
    return _fill(Vehicle, values), _fill(Plant, values), _fill(Control, values), _fill(Sensors, values)


def _fill(kind: type[T], values: Mapping[str, float]) -> T:
    return kind(*(values[name] for name in kind._fields))
