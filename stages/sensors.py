"""Sensors that scatter too much, or do not move any more: `sensor_noise` and `sensor_stuck` (chapter I).

Three measures of every signal are remembered over ``tau_s``, in logarithms, so that a spike is no more than
one sample; with m a mean over the raster, rough as in :mod:`stages.roughness`, and m' what m should be by all
other signals (``expected``, a formula of signals and relations):

    u = ln rough - 2 ln max(|m|, least),    v = ln (m_k - m_(k-1))^2,    w = v - ln (m'_k - m'_(k-1))^2.

Fault-free calibration logs say the largest u and the smallest v and w, and for how long m stood quite still.
The evidence, in nats as that of the stages before, is ``LEAST`` at the threshold:

    noise   LEAST (u - largest) / noise_margin
    stuck   LEAST max(min(smallest w - w, smallest v - v + stuck_margin) / stuck_margin, still_s / least_s).

The first form of `stuck` is for what stands still but for the noise of its converter: it moves less than it
should beside the others, and less than it ever did. So neither an engine at idle that was never seen at idle
looks like it, nor one whose other sensors scatter. The second takes ``min_still_s`` and three times as long
as a healthy signal stood still, as one that is coarsely resolved does; such a one is not judged by the first.

Nothing is learned from a sample, for or against, where ``where`` is not positive (an engine that stands has
nothing to measure), where no other signal moves (a logger that stands), and of noise where the log has
another rate than the calibration logs.

A fault is named once its evidence has been above ``LEAST`` for ``confirm_s``. What such a sensor reads may
look like anything, so the other faults explain the residuals no better than it does: its evidence is then
that of the best of them, and its own. Columns ``sensor.<fault>.<signal>`` have its own, by signal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError, did_you_mean
from ingest.log import TIME, Log
from stages.formula import Formula
from stages.results import DETECTION, EVIDENCE, EXPECTED, EXPECTED_SD, OF, PROBABILITY, SENSOR
from stages.roughness import ROUGH, SAMPLE_S
from stages.smooth import first_order
from stages.stage import ANALYSIS, Arrays, add_columns, columns

Array = NDArray[np.float64]
FAULTS = ("sensor_noise", "sensor_stuck")
LEAST, MOST = 12.0, 120.0  # nats: evidence at the threshold, and at most
STILL = 1e-7  # relative change that is none
COARSE_S = 1.0  # rest of a healthy signal that makes it a coarse one
TIMES, RATES = 3.0, 1.5  # of the longest rest, and how far the log's rate may be from that learned


class Measures(NamedTuple):
    """Per sample: u, v and w, (3, signals, rows), and whether they are known; whether the signal did not
    move, (signals, rows); the time that the sample stands for, (rows,)."""

    x: Array
    known: NDArray[np.bool_]
    rests: NDArray[np.bool_]
    dt: Array


@dataclass(frozen=True, eq=False)
class SensorsState:
    """Time of the last sample, its means and what they should be, (2, signals); u, v and w as remembered, and
    for how long the signal has stood still, (4, signals); for how long each fault has been above its
    threshold, (faults, signals)."""

    time: float
    means: Array
    memory: Array
    over: Array


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """``signals``: the sensors, with columns ``rough.<signal>``; ``where``: a formula, positive where they
    have something to measure; ``expected``: formulas of what a sensor should read by all others (columns
    ``expected.<signal>`` and, from the calibration logs, ``expected_sd.<signal>``); ``temper``: as of the
    stage `isolate`.

    Raises:
        RecipeError: no signals, or nothing learned yet.
        LogError: a signal has no value in the calibration logs.
    """

    version: ClassVar[str] = "1"
    learns_from: ClassVar[Literal["calibration"]] = "calibration"
    signals: tuple[str, ...]
    where: str = "1"
    expected: Mapping[str, str] = field(default_factory=dict)
    tau_s: float = 10.0
    noise_margin: float = 1.0
    stuck_margin: float = 1.5
    min_still_s: float = 10.0
    confirm_s: float = 5.0
    max_gap_s: float = 2.0
    temper: float = 0.5
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.signals:
            raise RecipeError("sensors: `signals` is empty; name at least one signal")
        if foreign := self.expected.keys() - {*self.signals}:
            name = min(foreign)
            raise RecipeError(f"sensors: expected {name!r} is no signal; {did_you_mean(name, self.signals)}")
        assert self.running is not None
        assert self.formulas is not None

    @cached_property
    def running(self) -> Formula:
        return Formula(self.where)

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        return {signal: Formula(text) for signal, text in self.expected.items()}

    @property
    def needs(self) -> set[str]:
        formulas = (self.running, *self.formulas.values())
        return {SAMPLE_S, *self.signals, *(ROUGH + s for s in self.signals)}.union(
            *(f.names for f in formulas)
        )

    @property
    def adds(self) -> set[str]:
        by_signal = {SENSOR + f + OF + s for f in FAULTS for s in self.signals}
        by_signal |= {kind + s for s in self.expected for kind in (EXPECTED, EXPECTED_SD)}
        return by_signal | {DETECTION} | {kind + f for f in FAULTS for kind in (EVIDENCE, PROBABILITY)}

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Any]] = (), /) -> Self:
        parts = [columns(block) for block in blocks]
        values = {n: np.concatenate([p[n] for p in parts]) for n in {TIME, *self.needs}}
        size = np.abs([values[s] for s in self.signals])
        size[:, ~self._judged(values)] = np.nan
        if lacking := [s for s, x in zip(self.signals, size, strict=True) if not np.isfinite(x).any()]:
            raise LogError(
                f"signal {lacking[0]!r} has no value in the calibration logs where {self.where!r} is positive"
            )
        learned: dict[str, NDArray[Any]] = {
            "scale": np.nanmedian(size, axis=1),
            "least": np.nanquantile(size, 0.01, axis=1),
            "sample_s": np.array(np.nanmedian(values[SAMPLE_S])),
        }
        expected = self._expected(values)
        error = np.where(self._judged(values), expected - [values[s] for s in self.signals], np.nan)
        square = np.where(np.isfinite(error), error, 0.0) ** 2
        learned["expected_sd"] = np.sqrt(square.sum(axis=1) / np.maximum(np.isfinite(error).sum(axis=1), 1))
        stage = replace(self, learned=learned)
        found = [stage._measures(np.nan, np.full((2, len(self.signals)), np.nan), part) for part in parts]
        learned["usual"] = _medians(found)
        stage = replace(self, learned=learned)
        remembered = [stage._remembered(stage.start().memory, measures) for measures in found]
        u, v, w, still = (np.concatenate([x[k] for x in remembered], axis=1) for k in range(4))
        extremes = {"u": u.max(axis=1), "v": v.min(axis=1), "w": w.min(axis=1), "still_s": still.max(axis=1)}
        return replace(self, learned={**learned, **extremes})

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self.fit(blocks)

    def start(self) -> SensorsState:
        if not self.learned:
            raise RecipeError("sensors: nothing learned yet; fit it first")
        S = len(self.signals)
        memory = self.learned["usual"]
        return SensorsState(np.nan, np.full((2, S), np.nan), memory, np.zeros((len(FAULTS), S)))

    def step(self, state: SensorsState, block: Log, /) -> tuple[SensorsState, Log]:
        values = columns(block, [TIME, *self.needs])
        measures = self._measures(state.time, state.means, values)
        memory = self._remembered(state.memory, measures)
        evidence = self._evidence(memory)
        over = _lasting(evidence >= LEAST, measures.known[:2], measures.dt, state.over)
        added = self._columns(block, evidence, over >= self.confirm_s)
        expected = self._expected(values)
        for i, signal in enumerate(self.signals):
            if signal in self.expected:
                sd = np.full(expected.shape[1], self.learned["expected_sd"][i], np.float32)
                added |= {EXPECTED + signal: expected[i].astype(np.float32), EXPECTED_SD + signal: sd}
        if values[TIME].size:
            means = np.stack([[values[s][-1] for s in self.signals], expected[:, -1]])
            state = SensorsState(float(values[TIME][-1]), means, memory[:, :, -1], over[:, :, -1])
        return state, add_columns(block, added)

    def _expected(self, values: Mapping[str, Array]) -> Array:
        """What each signal should be, shape (signals, rows); NaN where no formula says it."""
        out = np.full((len(self.signals), values[TIME].size), np.nan)
        for i, signal in enumerate(self.signals):
            if signal in self.formulas:
                out[i] = self.formulas[signal](values)
        return out

    def _judged(self, values: Mapping[str, Array]) -> NDArray[np.bool_]:
        return np.asarray(np.broadcast_to(self.running(values), values[SAMPLE_S].shape) > 0)

    def _measures(self, time: float, means: Array, values: Mapping[str, Array]) -> Measures:
        """What the rows say, after a row at ``time`` with the ``means`` and what they should be."""
        learned, dt = self.learned, np.diff(values[TIME], prepend=time)
        m = np.array([values[s] for s in self.signals])
        rough = np.array([values[ROUGH + s] for s in self.signals])
        moved = np.diff(m, axis=1, prepend=means[0][:, None])
        should = np.diff(self._expected(values), axis=1, prepend=means[1][:, None])
        together = dt <= self.max_gap_s
        rests = together & (np.abs(moved) <= STILL * learned["scale"][:, None])
        others = rests.sum(axis=0) - rests < max(len(m) - 1, 1)
        rate = values[SAMPLE_S] / learned["sample_s"]
        tiny = (STILL * learned["scale"][:, None]) ** 2
        size = np.maximum(np.abs(m), learned["least"][:, None])
        u, v = np.log(np.maximum(rough, tiny) / size**2), np.log(moved**2 + tiny)
        x = np.stack([u, v, v - np.log(should**2 + tiny)])
        known = np.isfinite(x) & self._judged(values) & together
        known[0] &= (rate < RATES) & (rate > 1 / RATES)
        known[1:] &= others
        return Measures(x, known, rests, np.where(together, dt, 0.0))

    def _remembered(self, memory: Array, measures: Measures) -> Array:
        """u, v, w and s of standing still, shape (4, signals, rows)."""
        gain = np.where(measures.known, -np.expm1(-measures.dt / self.tau_s), 0.0)
        x = np.where(measures.known, measures.x, 0.0)
        out = np.empty((4, *x.shape[1:]))
        for k, i in np.ndindex(x.shape[:2]):
            out[k, i] = first_order(gain[k, i], x[k, i], float(memory[k, i]))
        out[3] = _lasting(measures.rests, measures.known[1], measures.dt, memory[3])
        return out

    def _evidence(self, memory: Array) -> Array:
        """Of noise and of being stuck, shape (faults, signals, rows)."""
        u, v, w, still = (
            x - self.learned[k][:, None] for x, k in zip(memory, ("u", "v", "w", "still_s"), strict=True)
        )
        longest = self.learned["still_s"][:, None]
        moved = np.where(longest < COARSE_S, np.minimum(-w, self.stuck_margin - v) / self.stuck_margin, 0.0)
        stuck = np.maximum(moved, (still + longest) / np.maximum(self.min_still_s, TIMES * longest))
        return np.clip(LEAST * np.stack([u / self.noise_margin, stuck]), 0.0, MOST)

    def _columns(self, block: Log, evidence: Array, named: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        """Evidence and probabilities of the faults, the probabilities of all else among them, and alarms."""
        added: dict[str, NDArray[Any]] = {
            SENSOR + fault + OF + signal: evidence[f, s].astype(np.float32)
            for f, fault in enumerate(FAULTS)
            for s, signal in enumerate(self.signals)
        }
        most, sure = evidence.max(axis=1), named.any(axis=1)
        there = block.groups[ANALYSIS].frame
        on = there[DETECTION].to_numpy() > 0 if DETECTION in there.columns else np.zeros(sure.shape[1], bool)
        added[DETECTION] = (on | sure.any(axis=0)).astype(np.int8)
        if not sure.any():  # the same, for less
            added |= {EVIDENCE + fault: x.astype(np.float32) for fault, x in zip(FAULTS, most, strict=True)}
            return added | {PROBABILITY + fault: np.zeros(on.shape, np.float32) for fault in FAULTS}
        rivals = [c.removeprefix(EVIDENCE) for c in there.columns if c.startswith(EVIDENCE)]
        known = columns(block, [kind + f for f in rivals for kind in (EVIDENCE, PROBABILITY)])
        best = np.max([np.zeros(on.shape), *(np.nan_to_num(known[EVIDENCE + f]) for f in rivals)], axis=0)
        odds = np.vstack([on, np.where(sure, np.exp(self.temper * most), 0.0)])
        share = odds / np.maximum(odds.sum(axis=0), 1e-300)
        shown = np.where(sure, best + most, most)
        added |= {EVIDENCE + fault: x.astype(np.float32) for fault, x in zip(FAULTS, shown, strict=True)}
        added |= {
            PROBABILITY + fault: x.astype(np.float32) for fault, x in zip(FAULTS, share[1:], strict=True)
        }
        return added | {
            PROBABILITY + f: (known[PROBABILITY + f] * share[0]).astype(np.float32) for f in rivals
        }


def _medians(found: Sequence[Measures]) -> Array:
    """Of u, v, w and of standing still, shape (4, signals); of what is never known, 0."""
    x = np.concatenate([np.where(m.known, m.x, np.nan) for m in found], axis=2)
    out = np.zeros((4, x.shape[1]))
    for k, i in np.ndindex(x.shape[:2]):
        if np.isfinite(x[k, i]).any():
            out[k, i] = np.nanmedian(x[k, i])
    return out


def _lasting(holds: NDArray[np.bool_], known: NDArray[np.bool_], dt: Array, before: Array) -> Array:
    """For how long ``holds`` (..., rows) has held, in s of ``known`` rows; ``before`` at the start."""
    passed = np.concatenate([before[..., None], np.where(known, dt, 0.0)], axis=-1)
    clock = np.cumsum(passed, axis=-1)[..., 1:]
    return np.asarray(clock - np.maximum.accumulate(np.where(holds, 0.0, clock), axis=-1))
