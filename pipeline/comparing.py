"""Champion and challenger on the same held-out logs, as they are and with injected faults: a table of
paired differences with their uncertainty, a verdict per row, and one for all.

Uncertainty is that of the held-out logs and, where thresholds matter, of the calibration logs that set them
(:mod:`stages.paired`). Rows that pool a quantity over all faults decide about the whole, each at a level that
keeps a false "worse" of the whole below 5 %; the rows of single faults and regimes say where it comes from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import StoreError
from ingest.log import Log
from pipeline.detector import Detector
from pipeline.trial import (
    NONE,
    Injection,
    Trial,
    attempt,
    injections,
    judged_residuals,
    prepare,
    same_preparation,
)
from stages.isolate import Isolate
from stages.paired import BETTER, UNDECIDED, WORSE, Interval, compare

Array = NDArray[np.float64]
RESAMPLINGS = 200  # of the calibration logs
LEAST_H = 0.01  # weighted time in a regime below which a log says nothing of it
POOLED = 6  # rows that decide
# by kind of row: more is better, what nobody would call a difference, the loss that is accepted. Evidence
# goes with the square of the size that shows: 0.2 is 10 % of that, and twice what another choice of training
# drives moves the evidence of a fault by (standard deviation; over all faults half of that).
FALSE = "false alarms per h"
KINDS: dict[str, tuple[bool, float, float]] = {
    FALSE: (False, 0.0, 0.1),
    "detected": (True, 0.0, 0.02),
    "named right": (True, 0.0, 0.02),
    "delay": (False, 1.0, 3.0),
    "log evidence": (True, 0.2, 0.2),
    "residual sigma": (False, 0.02, 0.05),
    "in domain": (True, 0.005, 0.02),
}
UNITS = {FALSE: "1/h", "delay": "s", "residual sigma": "ln", "log evidence": "ln"}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line: what, of which fault and size (or residual and regime), and the paired difference, more being
    better. ``pooled`` rows decide about the whole; a row without ``interval`` is for information."""

    what: str
    of: str = ""
    size: float | None = None
    unit: str = ""
    pooled: bool = False
    interval: Interval | None = None
    champion: float | None = None
    challenger: float | None = None

    def to_json(self) -> dict[str, Any]:
        head = {k: getattr(self, k) for k in ("what", "of", "size", "unit", "pooled")}
        numbers = {"champion": self.champion, "challenger": self.challenger, "difference": None, "low": None,
                   "high": None, "drives": None, "verdict": None}  # fmt: skip
        return {**head, **(self.interval.to_json() if self.interval else numbers)}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """``verdict`` of the whole: worse if a pooled row is, else better if one is, else not worse if all
    are."""

    champion: str
    challenger: str
    logs: tuple[str, ...]
    hours: float
    rows: tuple[Row, ...]
    verdict: str

    def to_json(self) -> dict[str, Any]:
        named = {k: getattr(self, k) for k in ("champion", "challenger", "hours", "verdict")}
        return {**named, "logs": list(self.logs), "rows": [r.to_json() for r in self.rows]}


def compare_detectors(
    champion: Detector,
    challenger: Detector,
    logs: Sequence[Log],
    faults: Sequence[Injection] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Comparison:
    """Replay both detectors on ``logs``, which must be fault-free and unseen, and compare; ``faults`` to
    inject are :func:`pipeline.trial.injections` if none are given.

    Raises:
        StoreError: they are not of one recipe.
        LogError: a log lacks a signal.
    """
    if champion.recipe.name != challenger.recipe.name:
        raise StoreError(
            f"detector {champion.key} is of recipe {champion.recipe.name!r}, {challenger.key} of "
            f"{challenger.recipe.name!r}; compare detectors of one recipe"
        )
    pairs: dict[Injection, list[tuple[Trial, Trial]]] = {}
    shared = same_preparation(champion, challenger)
    if faults is None:
        faults = [i for i in injections(champion) if i in injections(challenger)]
    for log in logs:
        one = prepare(champion, log)
        two = one if shared else prepare(challenger, log)
        for injection in (Injection(), *faults):
            a, regimes = attempt(champion, one, injection)
            b, _ = attempt(challenger, two, injection, regimes)
            pairs.setdefault(injection, []).append((a, b))
        progress(log.name)
    rng = np.random.default_rng(seed)
    rows = [*_rows(pairs, _thresholds(champion, challenger, rng), champion, rng)]
    rows += [_size(champion, challenger), _speed(pairs)]
    return Comparison(
        champion=champion.key, challenger=challenger.key, logs=tuple(log.name for log in logs),
        hours=sum(a.hours for a, _ in pairs[Injection()]), rows=tuple(rows), verdict=_whole(rows),
    )  # fmt: skip


def _whole(rows: Sequence[Row]) -> str:
    verdicts = [r.interval.verdict for r in rows if r.pooled and r.interval]
    for found in (WORSE, UNDECIDED, BETTER):
        if found in verdicts and not (found == UNDECIDED and BETTER in verdicts):
            return found
    return "not worse" if verdicts else UNDECIDED


def _thresholds(
    champion: Detector, challenger: Detector, rng: np.random.Generator
) -> tuple[Array, Array] | None:
    """Thresholds as they are, then with the calibration logs drawn anew, (resamplings, memories + 2, faults);
    the same draws for both where they were calibrated on the same logs. None where nothing is isolated."""
    stages = [next((s for s in d.stages if isinstance(s, Isolate)), None) for d in (champion, challenger)]
    counts = [len(s.learned["largest"]) for s in stages if s is not None]
    if len(counts) < 2:
        return None
    draws = [rng.integers(n, size=(RESAMPLINGS, n)) for n in counts]
    if champion.record["calibration"] == challenger.record["calibration"] and counts[0] == counts[1]:
        draws[1] = draws[0]
    one, two = (_resampled(s, d) for s, d in zip(stages, draws, strict=True) if s is not None)
    return one, two


def _resampled(stage: Isolate, draws: NDArray[np.int64]) -> Array:
    largest, threshold = stage.learned["largest"], stage.learned["threshold"]
    shift = threshold - stage.thresholds(largest)  # set for a rate of false alarms
    return np.stack([threshold, *(stage.thresholds(largest[d]) + shift for d in draws)])


def _rows(
    pairs: dict[Injection, list[tuple[Trial, Trial]]],
    thresholds: tuple[Array, Array] | None,
    champion: Detector,
    rng: np.random.Generator,
) -> Iterator[Row]:
    healthy = pairs[Injection()]
    table = _Table(thresholds, rng)
    yield table.row(FALSE, healthy, pooled=True)
    faulty = {i: trials for i, trials in pairs.items() if i.fault != NONE}
    for what in ("detected", "named right", "delay", "log evidence"):
        if faulty and (what != "log evidence" or thresholds):
            yield table.row(what, [*faulty.values()], pooled=what != "delay")
            for injection, trials in faulty.items():
                head = table.row(what, trials, pooled=False)
                unit = {"1": ""}.get(injection.unit, injection.unit)
                yield replace(head, of=f"{injection.fault} {injection.size:+g} {unit}".rstrip())
    yield table.sigma(healthy, None, None, "")
    for r, name in enumerate(judged_residuals(champion)):
        yield table.sigma(healthy, r, None, name)
        for m in range(healthy[0][0].square.shape[1]):
            yield table.sigma(healthy, r, m, f"{name} in regime {m}")
    yield table.row("in domain", healthy, pooled=True)


class _Table:
    """Makes rows from trials."""

    def __init__(self, thresholds: tuple[Array, Array] | None, rng: np.random.Generator) -> None:
        self.thresholds, self.rng = thresholds, rng

    def row(self, what: str, trials: Any, *, pooled: bool) -> Row:
        """``trials``: pairs, or for a pooled row over faults a list of them by fault, averaged per log."""
        groups = trials if trials and isinstance(trials[0], list) else [trials]
        values = []
        for side in (0, 1):
            each = np.stack([self._values(what, [p[side] for p in g], side) for g in groups])
            known = np.isfinite(each)
            count = known.sum(axis=0)
            values.append(np.where(known, each, 0).sum(axis=0) / np.where(count, count, np.nan))
        hours = np.array([p[0].hours for p in groups[0]])
        weight = hours if what == FALSE else np.ones(len(hours))
        return self._made(what, values[0], values[1], weight, pooled=pooled)

    def sigma(
        self, healthy: Sequence[tuple[Trial, Trial]], residual: int | None, regime: int | None, of: str
    ) -> Row:
        """ln of the root mean square of a residual, over all if None."""
        values = []
        for side in (0, 1):
            square, mass = (_stacked([getattr(p[side], k) for p in healthy]) for k in ("square", "mass"))
            rows = slice(None) if residual is None else [residual]
            square, mass = square[:, rows], mass[:, rows]
            if regime is None:
                square, mass = square.sum(axis=2), mass.sum(axis=2)
            else:
                square, mass = square[:, :, regime], mass[:, :, regime]
            seen = mass * 0.5 / 3600 > LEAST_H
            rms = np.where(seen, np.sqrt(square / np.maximum(mass, 1e-12)), np.nan)
            values.append(np.log(np.maximum(rms, 1e-12)).mean(axis=1)[None])
        return replace(
            self._made(
                "residual sigma", values[0], values[1], np.ones(len(healthy)), pooled=residual is None
            ),
            of=of,
        )

    def _values(self, what: str, trials: Sequence[Trial], side: int) -> Array:
        """Shape (resamplings or 1, drives)."""
        if what == "delay":
            return np.array([[t.delay_s for t in trials]])
        if what == "in domain":
            return np.array([[t.domain for t in trials]])
        if what == "named right":
            return np.array([[float(t.alarm and t.named == t.injection.fault) for t in trials]])
        if self.thresholds is None:
            alarms = np.array([[float(t.alarm) for t in trials]])
        else:
            largest = np.stack([t.largest for t in trials if t.largest is not None])
            over = largest[None] / np.maximum(self.thresholds[side][:, None], 1e-12)
            if what == "log evidence":
                return np.asarray(np.log(np.maximum(over.max(axis=(2, 3)), 1e-3)))
            alarms = (over > 1).any(axis=(2, 3)).astype(float)
            alarms[0] = [float(t.alarm) for t in trials]
        return alarms / [t.hours for t in trials] if what == FALSE else alarms

    def _made(self, what: str, a: Array, b: Array, weight: Array, *, pooled: bool) -> Row:
        more, same, margin = KINDS[what]
        rows = max(len(a), len(b))
        interval = compare(
            np.broadcast_to(a, (rows, a.shape[1])), np.broadcast_to(b, (rows, b.shape[1])), weight, self.rng,
            more_is_better=more, same=same, margin=margin, share=what in ("detected", "named right"),
            rate=what == FALSE,
            level=1 - 0.05 / POOLED if pooled else 0.95,
        )  # fmt: skip
        return Row(what=what, unit=UNITS.get(what, ""), pooled=pooled, interval=interval)


def _stacked(arrays: Sequence[Array]) -> Array:
    """Arrays of different numbers of regimes, filled up with 0; (drives, residuals, regimes)."""
    M = max(a.shape[1] for a in arrays)
    return np.stack([np.pad(a, ((0, 0), (0, M - a.shape[1]))) for a in arrays])


def _size(champion: Detector, challenger: Detector) -> Row:
    one, two = (sum(a.nbytes for a in d.arrays.values()) / 1024 for d in (champion, challenger))
    return Row(what="size", unit="KiB", champion=one, challenger=two)


def _speed(pairs: dict[Injection, list[tuple[Trial, Trial]]]) -> Row:
    sums = [sum(p[side].cpu_s for p in pairs[Injection()]) for side in (0, 1)]
    hours = sum(p[0].hours for p in pairs[Injection()])
    return Row(what="CPU s per h of log", unit="s/h", champion=sums[0] / hours, challenger=sums[1] / hours)
