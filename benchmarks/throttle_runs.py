"""Simulated logs of the throttle, monitored: what the benchmark's tables are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from ingest.log import Log
from ingest.simulators.faults import Fault
from ingest.simulators.throttle import simulate_throttle
from pipeline.recipe import load_recipe
from stages.compensate import Compensate
from stages.monitor import SIGNALS
from stages.stage import ANALYSIS, transform

STAGES = load_recipe("throttle").stages
ONSET, RAMP, COMPENSATED_FROM = 25.0, 25.0, 30.0
Changes = Sequence[tuple[str, float]]
FAULTS: dict[str, Changes] = {
    "none": (),
    "tps_time_constant": (("tps_time_constant", 0.5),),
    "tps_gain": (("tps_gain", -0.4),),
    "motor_torque_constant": (("motor_torque_constant", -0.4),),
    "back_emf_constant": (("back_emf_constant", -0.4),),
}  # Table 3.2


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table."""

    part: int
    what: str
    measured: str
    target: str = ""
    holds: bool | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A monitored log: its windows, what was said at their end, since when that stood, alarms before the
    onset, and by which factor the readings became better after 30 s, as they are and without measurement
    noise."""

    frame: pl.DataFrame
    named: str
    delay: float | None
    early: int
    better: float = np.nan
    better_systematic: float = np.nan


def simulate(changes: Changes, seed: int, *, ramp: float = RAMP, **overrides: float) -> Log:
    faults = [Fault(name=n, magnitude=m, onset_s=ONSET, ramp_s=ramp) for n, m in changes]
    return simulate_throttle(seed=seed, faults=faults, overrides=overrides)


def monitored(log: Log, fault: str | None = None) -> Run:
    """``fault``: what was injected, where its compensation is of interest."""
    out = transform(STAGES, log)
    frame = out.groups[ANALYSIS].frame
    time, alarm = frame["time"].to_numpy(), frame["detection"].to_numpy() > 0
    names = [c.removeprefix("p.") for c in frame.columns if c.startswith("p.")]
    best = np.array(names)[frame.select("^p\\..*$").to_numpy().argmax(axis=1)]
    said = np.where(alarm, best, "none")
    stands = int(np.flatnonzero(said != said[-1])[-1]) + 1 if (said != said[-1]).any() else 0
    delay = float(time[stands]) - ONSET if said[-1] != "none" else None
    run = Run(frame=frame, named=str(said[-1]), delay=delay, early=int(alarm[time <= ONSET + 1e-6].sum()))
    if fault is None:
        return run
    systematic = _systematic(log, out) if fault == "tps_time_constant" else np.nan
    return replace(run, better=_ratio(log, out), better_systematic=systematic)


def _ratio(log: Log, out: Log) -> float:
    """RMS error of the raw over that of the corrected reading."""
    frame = out.groups[SIGNALS].frame
    healthy = log.values("truth.theta_ang")
    late = frame["time"].to_numpy() > COMPENSATED_FROM
    raw, corrected = (
        np.sqrt(np.mean((frame[c].cast(pl.Float64).to_numpy() - healthy)[late] ** 2))
        for c in ("theta_ang", "theta_ang.corrected")
    )
    return float(raw / corrected)


def _systematic(log: Log, out: Log) -> float:
    """The same without the measurement noise: the run's own decisions, applied to the reading before w_n."""
    faults = [Fault(**f) for f in log.facts["faults"]]
    quiet = simulate_throttle(
        seed=log.facts["seed"], faults=faults, overrides=log.facts["overrides"], noise=0.0
    )
    group = out.groups[SIGNALS]
    frame = group.frame.select("time", pl.Series("theta_ang", quiet.values("theta_ang")))
    block = replace(out, groups={**out.groups, SIGNALS: replace(group, frame=frame, signals={})})
    return _ratio(log, transform([s for s in STAGES if isinstance(s, Compensate)], block))
