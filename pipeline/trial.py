"""Trial: a detector on a held-out log, as it is or with an injected fault, in a few numbers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, StoreError
from ingest.log import Event, Log
from pipeline.detector import Detector
from pipeline.diagnosing import judge, samples_table, supposed
from stages.gate import GATE
from stages.injecting import inject, injectable
from stages.isolate import Isolate
from stages.relations import IN_DOMAIN, REGIME
from stages.residuals import RESIDUAL, Residuals
from stages.stage import ANALYSIS, RowWise, Stage, add_columns, columns, transform

Array = NDArray[np.float64]
NONE = "none"
LONGEST_S = 900.0  # of a log with an injected fault


@dataclass(frozen=True, kw_only=True)
class Injection:
    """A fault to inject; ``none`` leaves the log as it is."""

    fault: str = NONE
    size: float = 0.0
    unit: str = "1"


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """What a detector said of one log.

    ``largest``: the largest evidence, (memories + 2, faults), where the recipe isolates; ``square`` and
    ``mass``: sums of e^2 and 1 by residual and regime of the reference, weighted by the gate, (residuals,
    regimes); ``domain``: share of the usable samples that lie in the trained domain.
    """

    log: str
    injection: Injection
    hours: float
    alarms: int
    named: str
    delay_s: float
    largest: Array | None
    square: Array
    mass: Array
    domain: float
    cpu_s: float

    @property
    def alarm(self) -> bool:
        return self.alarms > 0


def injections(detector: Detector) -> list[Injection]:
    """The faults that are injected: of every hypothesis that allows it the sizes a quarter and a half up
    its grid, to either side."""
    found = []
    for fault, h in supposed(detector.recipe).items():
        if not injectable(h):
            continue
        for side in ([s for s in h.sizes if s > 0], [s for s in reversed(h.sizes) if s < 0]):
            places = sorted({len(side) // 4, len(side) // 2}) if side else []
            found += [Injection(fault=fault, size=side[i], unit=h.unit) for i in places]
    return found


def same_preparation(one: Detector, two: Detector) -> bool:
    """Whether logs can be prepared once for both."""
    (a, _), (b, _) = split(one), split(two)
    return [*a] == [*b]


def prepare(detector: Detector, log: Log) -> Log:
    """A log after the first part of :func:`split`, on the analysis raster alone, without its events.

    Raises:
        LogError: it lacks a signal, or has no rows to judge.
    """
    block = transform(split(detector)[0], log)
    if block.groups[ANALYSIS].frame.height < 2:
        raise LogError(f"{log.name}: nothing is left of it on the analysis raster; take a longer log")
    return replace(block, groups={ANALYSIS: block.groups[ANALYSIS]}, events=())


def split(detector: Detector) -> tuple[Sequence[Stage], Sequence[Stage]]:
    """Stages before those that a fault is undone through, and the rest."""
    stages = detector.stages
    place = next((i for i, s in enumerate(stages) if isinstance(s, Isolate)), None)
    if place is None:
        place = next((i for i, s in enumerate(stages) if hasattr(s, "learned")), len(stages))
        return stages[:place], stages[place:]
    while place > 0 and isinstance(stages[place - 1], RowWise):
        place -= 1
    return stages[:place], stages[place:]


def judged_residuals(detector: Detector) -> list[str]:
    """The residuals that alarms come from."""
    known = [r for s in detector.stages if isinstance(s, Residuals) for r in s.residuals]
    named = [r for s in detector.stages if isinstance(s, Isolate) for r in s.residuals]
    return named or known


def attempt(
    detector: Detector, prepared: Log, injection: Injection, regimes: Array | None = None
) -> tuple[Trial, Array]:
    """A trial on what :func:`prepare` made of a log, and the regime of each row.

    ``regimes``: those by which residuals are summed, else the detector's own.

    Raises:
        StoreError: the detector has no regimes or residuals to compare by, as for `throttle`.
    """
    _, rest = split(detector)
    log = prepared
    start, end = log.groups[ANALYSIS].time[[0, -1]]
    onset = float(start)
    if injection.fault != NONE:
        onset = float(start + min(end - start, LONGEST_S) / 3)
        log = _with_fault(detector, prepared, injection, onset, float(start))
    began = time.process_time()
    block, largest = _through(rest, log)
    cpu_s = time.process_time() - began
    samples = samples_table(block.groups[ANALYSIS].frame)
    if REGIME not in samples.columns:
        raise StoreError(
            f"detector {detector.key} of recipe {detector.recipe.name!r} has no residuals by operating "
            "regime; two of its detectors cannot be compared on logs"
        )
    verdict = judge(log, samples, detector, {})
    late = [e for e in verdict.events if _after(e, onset)]
    own = np.nan_to_num(samples[REGIME].to_numpy().astype(float), nan=-1.0)
    by = own if regimes is None or len(regimes) != len(own) else regimes
    square, mass, domain = _sums(block, judged_residuals(detector), by)
    detected = verdict.detected_s if late and verdict.detected_s is not None else np.nan
    return Trial(
        log=log.name, injection=injection, hours=float(end - start) / 3600, alarms=len(late),
        named=verdict.fault, delay_s=detected - onset if detected >= onset else np.nan,
        largest=largest, square=square, mass=mass, domain=domain, cpu_s=cpu_s,
    ), own  # fmt: skip


def _after(event: Event, onset: float) -> bool:
    """Whether an event is the fault's: it lasts into the time in which the fault is there."""
    return event.t_end is None or event.t_end >= onset


def _with_fault(detector: Detector, log: Log, injection: Injection, onset: float, start: float) -> Log:
    return inject(
        log.between(start, start + LONGEST_S),
        supposed(detector.recipe)[injection.fault],
        injection.size,
        onset,
    )


def _through(stages: Sequence[Stage], log: Log) -> tuple[Log, Array | None]:
    """The log after all stages, and the largest evidence that the isolation met."""
    largest = None
    for stage in stages:
        if isinstance(stage, Isolate):
            log = _possible(log)
            state, log = stage.step(stage.start(), log)
            largest = state.memory.largest
        else:
            log = transform([stage], log)
    return log, largest


def _possible(log: Log) -> Log:
    """Samples without a residual get no weight: no engine could read what was injected there, such as a
    leak that is larger than the flow."""
    values = columns(log)
    residuals = [x for c, x in values.items() if c.startswith(RESIDUAL)]
    there = np.asarray(np.isfinite(np.array(residuals)).all(axis=0))
    return add_columns(log, {GATE: np.where(there, values.get(GATE, np.ones(len(there))), 0.0)}, {GATE: "1"})


def _sums(block: Log, judged: Sequence[str], regimes: Array) -> tuple[Array, Array, float]:
    values = columns(block)
    names = [RESIDUAL + r for r in judged]
    gate = np.nan_to_num(values.get(GATE, np.ones(len(regimes))))
    M = int(regimes.max(initial=0)) + 1
    square, mass = np.zeros((len(names), M)), np.zeros((len(names), M))
    for i, name in enumerate(names):
        e = values[name]
        known = np.isfinite(e) & (regimes >= 0)
        unit, w = regimes[known].astype(int), gate[known]
        square[i] = np.bincount(unit, w * e[known] ** 2, minlength=M)[:M]
        mass[i] = np.bincount(unit, w, minlength=M)[:M]
    inside = block.groups[ANALYSIS].frame[IN_DOMAIN].to_numpy().astype(float)
    usable = gate >= 0.5
    return square, mass, float(inside[usable].mean()) if usable.any() else np.nan
