"""Isolate by undoing: which supposed fault, undone on the log, makes the residuals those of a healthy system?

Every hypothesis f is undone at every size theta of its grid (:mod:`stages.hypotheses`), the residuals are
computed anew, and their log-likelihood L (:mod:`stages.likelihood`) is kept over several memories
(:mod:`stages.evidence`), and for a step where the operating point rests. Between two
sizes of the grid the residuals are interpolated linearly, at ``between - 1`` further sizes. With the
peak over sizes and its standard deviation d, the evidence for f is the Laplace approximation of the ratio of
marginal likelihoods,

    evidence_f = L_f(peak) + ln min(1, sqrt(2 pi) d / range of sizes) - L_healthy,

where being healthy includes the drifts that healthy systems show. ``unknown`` is any constant offset in every
residual of the log as it is, with standard deviation ``unknown_sd`` times the residual's spread; it pays
``unknown_penalty``, so that it wins only where all hypotheses leave much unexplained.

A sample that no hypothesis brings to where the relations were trained says nothing: its weight falls from 1
at a novelty of 1 to 0 at ``known_to``.

The alarm statistic is the largest amount by which the evidence of a fault over a memory exceeds its
threshold; it must be positive for ``confirm_s``. From then on the evidence is that of the episode, which
starts afresh (after a step, from the step's evidence) and forgets with the longest memory, or what was before
the fault's size changed, which must explain ``change`` more. ``p`` is the
softmax of the evidence times ``temper``, as samples are correlated beyond ``tau_c``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import TIME, Log
from stages.evidence import follow
from stages.formula import Formula
from stages.gate import GATE
from stages.hypotheses import Drift, Hypothesis, Points
from stages.memory import Memory, Rows, Settings
from stages.offsets import learned_offsets
from stages.relations import familiarity
from stages.residuals import Residuals, residual_names
from stages.results import DETECTABLE, DETECTION, EVIDENCE, PROBABILITY, SIZE, SIZE_SD, STATISTIC, UNKNOWN
from stages.size_grid import Grid, refined_grid
from stages.stage import ANALYSIS, Arrays, RowWise, Stage, add_columns, columns
from stages.thresholds import thresholds

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IsolateState:
    """Time of the log's first row, the last, and the last one looked at; and what the recursion remembers."""

    first: float
    time: float
    seen: float
    memory: Memory


@dataclass(frozen=True, kw_only=True)
class Isolate:
    """``offsets``: by residual, what differs from run to run: a shape's formula and its standard deviation,
    which counts as one log beside those of the calibration; ``residuals``: those to judge by, all if none is
    named; ``every_s``: one usable sample in this time is looked at and stands for the others; ``rest``:
    columns that no fault concerns, and the relative change of each that ends a rest (none: no steps).

    The threshold of a fault and a memory is ``margin`` more than the largest evidence in the calibration
    logs, at least ``min_threshold``, for a step ``min_step_threshold``; where the offsets are known from
    before it is what a healthy log exceeds with probability ``risk`` (:mod:`stages.thresholds`). An alarm
    ends when the fault has been gone for ``clear_s``; by ``change`` a fault of two sizes must be likelier
    than of one.

    Raises:
        RecipeError: fewer than two memories, or not rising; more than two shapes for a residual; no residuals
            before this stage; nothing learned yet.
    """

    version: ClassVar[str] = "8"
    learns_from: ClassVar[Literal["calibration"]] = "calibration"
    hypotheses: Mapping[str, Hypothesis]
    drifts: Mapping[str, Drift] = field(default_factory=dict)
    offsets: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    residuals: tuple[str, ...] = ()
    memories_s: tuple[float, ...] = (3.0, 10.0, 30.0, 100.0, 300.0)
    correlation_s: float = 2.0
    min_gate: float = 0.05
    every_s: float = 0.0
    clip: float = 4.0
    between: int = 4
    known_to: float = 1.2
    margin: float = 3.0
    min_threshold: float = 12.0
    min_step_threshold: float = 8.0
    risk: float = 0.003
    rest: Mapping[str, float] = field(default_factory=dict)
    rest_s: float = 30.0
    step_ages_s: tuple[float, ...] = (3.0, 5.0, 8.0)
    confirm_s: float = 1.0
    clear_s: float = 5.0
    decide_s: float = 0.5
    temper: float = 0.5
    unknown_sd: float = 30.0
    unknown_penalty: float = 60.0
    change: float = 20.0
    learned: Arrays = field(default_factory=dict)
    before: tuple[Stage, ...] = ()

    def __post_init__(self) -> None:
        m = self.memories_s
        if len(m) < 2 or m[0] <= 0 or any(b <= a for a, b in pairwise(m)):
            raise RecipeError(f"isolate: memories_s needs two or more rising times, got {list(m)}")
        if crowded := [r for r, shapes in self.offsets.items() if len(shapes) > 2]:
            raise RecipeError(
                f"isolate: at most two shapes of offset for a residual; {crowded[0]!r} has more"
            )

    @property
    def needs(self) -> set[str]:
        return self._shaped.union(self.rest, *(h.needs for h in self.hypotheses.values()))

    @cached_property
    def _formulas(self) -> dict[str, Formula]:
        return {text: Formula(text) for shapes in self.offsets.values() for text in shapes}

    @property
    def _shaped(self) -> set[str]:
        """What the offsets' shapes are made of."""
        return {name for formula in self._formulas.values() for name in formula.names}

    @property
    def adds(self) -> set[str]:
        faults = [*self.hypotheses, UNKNOWN]
        return (
            {DETECTION, STATISTIC}
            | {kind + f for f in faults for kind in (EVIDENCE, PROBABILITY)}
            | {DETECTABLE + f for f in self.hypotheses}
        )

    def connect(self, before: Sequence[Stage], /) -> Self:
        return replace(self, before=tuple(before))

    @cached_property
    def points(self) -> Points:
        """The grid, and the row-wise stages that are run again on corrected columns."""
        chain: list[RowWise] = []
        for stage in reversed(self.before):
            if not isinstance(stage, RowWise):
                break
            chain.insert(0, stage)
        known = [r for stage in chain if isinstance(stage, Residuals) for r in stage.residuals]
        residuals = self._judged(known)
        if not residuals:
            raise RecipeError(
                "isolate: put it right after the stages regressors, normalise, relations, residuals"
            )
        drifts = [d.hypothesis() for d in self.drifts.values()]
        return Points([*drifts, *self.hypotheses.values()], chain, residuals)

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        judged = self._judged(residual_names(blocks[0]))
        given = np.array([self.offsets.get(r, {}).get("1", 0.0) for r in judged])
        second = np.array([[*self.offsets.get(r, {}).values(), 0.0, 0.0][1] for r in judged])
        shapes = [self.shapes(columns(b), judged)[:, :, 1] for b in blocks]
        span, lasting = self.memories_s[-2], self.correlation_s
        learned = learned_offsets(blocks, judged, given, second, shapes, span, lasting)
        never = np.full((len(self.memories_s) + 2, len(self.hypotheses)), np.inf)
        silent, largest = replace(self, learned={**learned, "threshold": never}), []
        for block, passed in zip(blocks, before, strict=True):
            stage = silent.connect(passed)
            largest.append(np.maximum(stage.step(stage.start(), block)[0].memory.largest, 0.0))
        most = np.stack(largest)
        return replace(self, learned={**learned, "largest": most, "threshold": self.thresholds(most)})

    def thresholds(self, largest: Array) -> Array:
        """Thresholds (memories + 2, faults) from the largest evidence in each log, see
        :func:`stages.thresholds.thresholds`."""
        least = np.append(np.full(len(self.memories_s), self.min_threshold), self.min_step_threshold)
        return thresholds(largest, least, self.margin, self.risk)

    def _judged(self, known: Sequence[str]) -> list[str]:
        return [r for r in known if r in self.residuals] if self.residuals else [*known]

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self

    def start(self) -> IsolateState:
        if "threshold" not in self.learned:
            raise RecipeError("isolate: nothing learned yet; fit it first")
        memory = Memory.empty(
            memories=len(self.memories_s) + 2, residuals=len(self.points.residuals),
            points=len(self.grid.left) + 1, faults=len(self.hypotheses), places=len(self.rest),
            seconds=int(max(self.step_ages_s)) + 2 if self.rest else 0,
        )  # fmt: skip
        return IsolateState(np.nan, np.nan, np.nan, memory)

    def step(self, state: IsolateState, block: Log, /) -> tuple[IsolateState, Log]:
        time = block.groups[ANALYSIS].time
        values = columns(block)
        first = state.first if not time.size or np.isfinite(state.first) else float(time[0])
        dt = np.diff(time, prepend=state.time)
        dt = np.where(np.isfinite(dt), dt, self.correlation_s)
        gate = np.nan_to_num(values.get(GATE, np.ones(time.size)), nan=0.0)
        active, stands_for = self._looked_at(time, dt, gate >= self.min_gate, state.seen)
        wanted = {TIME, GATE, *self.points.needs} & values.keys()
        needed = {c: values[c][active] for c in wanted}
        e, sigma, doubt, novelty = self.points.evaluate(needed, time[active] - first)
        rows = Rows(
            dt=dt,
            active=np.where(active, np.cumsum(active) - 1, -1),
            place=self._place(values),
            share=np.minimum(stands_for / self.correlation_s, 1.0),
            weight=self.weight(stands_for) * familiarity(novelty, self.known_to),
            e=e,
            sigma=sigma,
            ln_sigma=np.log(sigma),
            doubt=doubt,
            shapes=self.shapes(needed | {c: values[c][active] for c in self._shaped}, self.points.residuals),
        )
        memory = Memory(*(x.copy() for x in state.memory))
        out = follow(rows, self.grid, self._settings, memory)
        last = float(time[-1]) if time.size else state.time
        seen = float(time[active][-1]) if active.any() else state.seen
        return IsolateState(first, last, seen, memory), add_columns(block, self._columns(*out))

    def _columns(
        self, statistic: Array, detection: NDArray[np.int8], evidence: Array, p: Array, size: Array,
        sd: Array, least: Array,
    ) -> dict[str, NDArray[Any]]:  # fmt: skip
        added: dict[str, NDArray[Any]] = {STATISTIC: statistic, DETECTION: detection}
        for i, fault in enumerate(self.hypotheses):
            added |= {
                EVIDENCE + fault: evidence[:, i].astype(np.float32),
                SIZE + fault: size[:, i],
                SIZE_SD + fault: _finite(sd[:, i]),
                PROBABILITY + fault: p[:, i].astype(np.float32),
                DETECTABLE + fault: _finite(least[:, i]).astype(np.float32),
            }
        return added | {
            EVIDENCE + UNKNOWN: evidence[:, -1].astype(np.float32),
            PROBABILITY + UNKNOWN: p[:, -1].astype(np.float32),
        }

    def weight(self, stands_for: Array) -> Array:
        """Which share of an independent sample a sample is that stands for some time (rows,), in s; shape
        (rows, residuals)."""
        return np.minimum(stands_for[:, None] / self.learned["correlation_s"], 1.0)

    def _looked_at(
        self, time: Array, dt: Array, usable: NDArray[np.bool_], seen: float
    ) -> tuple[NDArray[np.bool_], Array]:
        """The first usable row of every ``every_s``, and how long each stands for, in s; ``seen``: when the
        last one before was."""
        active = usable.copy()
        if self.every_s > 0:
            part = np.floor(np.append(seen, time[usable]) / self.every_s + 1e-6)
            active[usable] = part[1:] != part[:-1]
        stands_for = np.minimum(np.diff(time[active], prepend=seen), self.every_s)
        return active, np.fmax(stands_for, dt[active])

    def _place(self, values: Mapping[str, Array]) -> Array:
        """The operating point in units of what ends a rest, shape (rows, columns of ``rest``)."""
        place = np.empty((len(values[TIME]), len(self.rest)))
        for j, (name, within) in enumerate(self.rest.items()):
            place[:, j] = np.log(np.maximum(values[name], 1e-12)) / within
        return place

    def shapes(self, values: Mapping[str, Array], residuals: Sequence[str]) -> Array:
        """Offset shapes at each row, shape (rows, residuals, 2)."""
        shapes = np.zeros((len(values[TIME]), len(residuals), 2))
        for i, r in enumerate(residuals):
            for k, text in enumerate(self.offsets.get(r, {})):
                shapes[:, i, k] = self._formulas[text](values)
            if r not in self.offsets:
                shapes[:, i, 0] = 1.0  # for `unknown`
        return shapes

    @cached_property
    def _settings(self) -> Settings:
        """What the compiled recursion needs."""
        return Settings(
            memories=np.array([*self.memories_s, self.memories_s[-1], self.rest_s]),
            ages=np.array(self.step_ages_s if self.rest else ()),
            threshold=self.learned["threshold"],
            sd=self.sd,
            unknown_sd=self.wide_sd,
            clip=self.clip,
            confirm=self.confirm_s,
            clear=self.clear_s,
            decide=self.decide_s,
            temper=self.temper,
            penalty=self.unknown_penalty,
            change=self.change,
            wander=self.learned["wander_sd"],
        )

    @cached_property
    def sd(self) -> Array:
        """Standard deviations of the offsets, shape (residuals, 2)."""
        sd = np.zeros((len(self.points.residuals), 2))
        for i, r in enumerate(self.points.residuals):
            given = self.offsets.get(r, {})
            sd[i, : len(given)] = list(given.values())
            sd[i, 1] = self.learned["shape_sd"][i]
            if next(iter(given), None) == "1":
                sd[i, 0] = self.learned["offset_sd"][i]
        return sd

    @cached_property
    def wide_sd(self) -> Array:
        """The same, with the first offset wide enough for anything."""
        learned = {
            r: s.learned["sigma"][i, -1]
            for s in self.points.chain
            if isinstance(s, Residuals)
            for i, r in enumerate(s.residuals)
        }
        sigma = np.array([learned[r] for r in self.points.residuals])
        return np.column_stack([np.maximum(self.unknown_sd * sigma, self.sd[:, 0]), self.sd[:, 1]])

    @cached_property
    def grid(self) -> Grid:
        drifts, faults = len(self.drifts), [*self.hypotheses.values()]
        return refined_grid(faults, self.points.sizes[drifts:], drifts, self.between)


def _finite(x: Array) -> Array:
    return np.where(np.isfinite(x), x, np.nan)
