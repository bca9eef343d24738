"""Faults of the air path: what can be injected, and how strong each is at every sample."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ingest.errors import did_you_mean
from ingest.log import Event

__all__ = ["FAULTS", "SENSORS", "Fault", "FaultInputs", "fault_inputs", "fault_problems", "truth_events"]

SENSORS = {"W_HFM": "g/s", "p_Bst": "kPa", "p_Int": "kPa", "T_Int": "K"}  # the signals that can fail
_TO_SI = {"W_HFM": 1e-3, "p_Bst": 1e3, "p_Int": 1e3, "T_Int": 1.0}
_GAINS = {
    "maf_gain": "W_HFM",
    "boost_pressure_gain": "p_Bst",
    "intake_pressure_gain": "p_Int",
    "intake_temperature_gain": "T_Int",
}
_ON_SIGNAL = ("sensor_stuck", "sensor_noise", "sensor_offset")

# name: unit and allowed range of the magnitude
FAULTS: dict[str, tuple[str, float, float]] = {
    **dict.fromkeys(_GAINS, ("1", -0.9, 10.0)),
    "boost_leak": ("mm", 0.0, 30.0),
    "intake_leak": ("mm", 0.0, 30.0),
    "egr_stuck_open": ("%", 0.0, 100.0),
    "egr_stuck_closed": ("%", 0.0, 100.0),
    "sensor_stuck": ("1", -1.0, 10.0),
    "sensor_noise": ("1", 0.0, 10.0),
    "sensor_offset": ("", -math.inf, math.inf),  # in the signal's own unit
}


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault: severity s(t) rises from 0 at ``onset_s`` to 1 in ``ramp_s`` and is 0 again from ``end_s``.

    With magnitude m, reading y of the healthy sensor and severity s:

    ========================== ==========================================================================
    ``*_gain``                 y (1 + s m)
    ``sensor_offset``          y + s m, m in the signal's canonical unit
    ``sensor_noise``           y (1 + s m e), e white and normal: m is the relative standard deviation
    ``sensor_stuck``           y + s (h - y), h = (1 + m) x reading at the onset: 0 holds it, -1 reads zero
    ``boost_leak intake_leak`` hole of diameter s m, mm
    ``egr_stuck_*``            position (1 - s) u + s m, %: held at m whatever the command u
    ========================== ==========================================================================

    ``signal`` names the sensor of the ``sensor_*`` faults. ``onset_s`` None: a third of the log.
    """

    name: str
    magnitude: float
    onset_s: float | None = None
    ramp_s: float = 0.0
    end_s: float | None = None
    signal: str | None = None

    @property
    def channel(self) -> str | None:
        """The affected sensor, None where the fault is in the plant."""
        return _GAINS.get(self.name, self.signal)

    @property
    def unit(self) -> str:
        return FAULTS[self.name][0] or SENSORS[self.channel or ""]

    def starts(self, duration_s: float) -> float:
        """Onset in s in a log of ``duration_s``."""
        return duration_s / 3.0 if self.onset_s is None else self.onset_s

    def severity(self, time: NDArray[np.float64], duration_s: float) -> NDArray[np.float64]:
        """s(t) at the samples ``time`` (s), same shape, 0..1."""
        onset = self.starts(duration_s)
        rise = np.clip((time - onset) / self.ramp_s, 0.0, 1.0) if self.ramp_s > 0 else 1.0
        active = (time >= onset) & (time < (np.inf if self.end_s is None else self.end_s))
        return np.where(active, rise, 0.0)


class FaultInputs(NamedTuple):
    """All faults of a run as inputs of the plant, n samples; a named tuple, as the compiled plant takes it.

    Columns of the sensor arrays follow ``SENSORS`` (SI units): reading = gain y + offset, then drawn towards
    ``hold`` x the held reading by the weight ``stuck``. ``leak``: areas of boost and intake leak in m2,
    without discharge coefficient. ``egr``: weight and position (0..1) of a stuck valve.
    """

    gain: NDArray[np.float64]  # (n, 4)
    offset: NDArray[np.float64]  # (n, 4)
    stuck: NDArray[np.float64]  # (n, 4)
    hold: NDArray[np.float64]  # (n, 4)
    leak: NDArray[np.float64]  # (n, 2)
    egr: NDArray[np.float64]  # (n, 2)


def fault_problems(faults: Sequence[Fault], duration_s: float) -> Iterator[str]:
    """What is wrong with ``faults`` in a log of ``duration_s``, one sentence each."""
    for fault in faults:
        if fault.name not in FAULTS:
            yield f"unknown fault {fault.name!r}; {did_you_mean(fault.name, FAULTS)}"
            continue
        unit, low, high = FAULTS[fault.name]
        if not (math.isfinite(fault.magnitude) and low <= fault.magnitude <= high):
            yield f"fault {fault.name}: magnitude {fault.magnitude:g}; expected {low:g} … {high:g} [{unit}]"
        if fault.name in _ON_SIGNAL and fault.signal not in SENSORS:
            yield f"fault {fault.name}: signal {fault.signal!r}; {did_you_mean(str(fault.signal), SENSORS)}"
        if fault.name not in _ON_SIGNAL and fault.signal not in (None, _GAINS.get(fault.name)):
            yield f"fault {fault.name}: signal {fault.signal!r} is not part of it; leave it out"
        onset = fault.starts(duration_s)
        if not 0.0 <= onset < duration_s:
            yield f"fault {fault.name}: onset {onset:g} s; expected within the log, 0 … {duration_s:g} s"
        if not fault.ramp_s >= 0.0:
            yield f"fault {fault.name}: ramp {fault.ramp_s:g} s; expected 0 (abrupt) or more"
        if fault.end_s is not None and not fault.end_s > onset:
            yield f"fault {fault.name}: end {fault.end_s:g} s; expected after its onset at {onset:g} s"


def fault_inputs(
    faults: Sequence[Fault], time: NDArray[np.float64], duration_s: float, rng: np.random.Generator
) -> FaultInputs:
    """The faults as inputs at the samples ``time``; ``rng`` feeds ``sensor_noise`` alone.

    Several faults add up: gains and offsets per sensor, areas per leak; of stuck faults the last one counts.
    """
    n, m = len(time), len(SENSORS)
    inputs = FaultInputs(
        gain=np.ones((n, m)),
        offset=np.zeros((n, m)),
        stuck=np.zeros((n, m)),
        hold=np.ones((n, m)),
        leak=np.zeros((n, 2)),
        egr=np.zeros((n, 2)),
    )
    for fault in faults:
        s, size = fault.severity(time, duration_s), fault.magnitude
        if fault.channel is not None:
            _sensor_fault(inputs, fault, list(SENSORS).index(fault.channel), s, rng)
        elif fault.name.endswith("_leak"):
            inputs.leak[:, int(fault.name == "intake_leak")] += np.pi / 4.0 * (1e-3 * size * s) ** 2
        else:
            active = s > 0.0
            inputs.egr[active, 0], inputs.egr[active, 1] = s[active], size / 100.0
    return inputs


def _sensor_fault(
    inputs: FaultInputs, fault: Fault, column: int, s: NDArray[np.float64], rng: np.random.Generator
) -> None:
    if fault.name == "sensor_stuck":
        active = s > 0.0
        inputs.stuck[active, column], inputs.hold[active, column] = s[active], 1.0 + fault.magnitude
    elif fault.name == "sensor_offset":
        inputs.offset[:, column] += s * fault.magnitude * _TO_SI[fault.channel or ""]
    elif fault.name == "sensor_noise":
        inputs.gain[:, column] += s * fault.magnitude * rng.standard_normal(len(s))
    else:
        inputs.gain[:, column] += s * fault.magnitude


FAULT_FREE = Event(t_start=0.0, kind="none", source="truth")
"""Ground truth of a log that is known to have no fault."""


def truth_events(faults: Sequence[Fault], duration_s: float) -> tuple[Event, ...]:
    """Ground truth: one event per fault, or :data:`FAULT_FREE`."""
    made = tuple(
        Event(
            t_start=fault.starts(duration_s),
            t_end=fault.end_s,
            kind=fault.name,
            channel=fault.channel,
            source="truth",
            magnitude=fault.magnitude,
            unit=fault.unit,
        )
        for fault in faults
    )
    return made or (FAULT_FREE,)
