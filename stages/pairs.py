"""Pairs: two faults at once, where one alone leaves something unexplained.

After the stage `isolate`, on at most ``rows`` of an alarm's usable samples, evenly, whenever the alarm has
2.5 times as many as before. Where a second fault adds little to what the likeliest one explains
(:mod:`stages.additive`), and no pair was near before, that is all. Else the two of every pair that does not
explain far less, a sensor's fault and another of ``faults``, are undone one after the other at a few sizes
and on a few samples, and Newton's steps on the log-likelihood L (:mod:`stages.likelihood`) find both sizes.
With d the standard deviation of a size, C the covariance of the two, and f* the best single fault,

    evidence_fg = evidence_f* + L_fg + ln(2 pi |C|^1/2 / ranges) - max(L_f* + penalty, L_h),
    L_f* = max_f [L_f + ln(sqrt(2 pi) d / range)],

where L_h is that of the best single fault whose size changes once within the samples: one fault that grows or
ends is not two. Nor are two of three faults ``alike`` that say no more than the third. What the relations are
in doubt of is shared by the samples of a regime here, not by all: else a second fault explains what only
differs between regimes. The probabilities are those of the stage before, with the pairs among the
suppositions. Where much is explained, errors of the relations explain more, too, and those of what f* does,
an ``inexact`` part of it: all evidence then counts

    1 / (1 + model_error gain + min(inexact^2 evidence_f*, UNSURE)),

with the gain of the best pair. Two faults at once are a requirement of section 1.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, pairwise
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, did_you_mean
from ingest.log import TIME, Log
from stages.alarm_window import Window
from stages.gate import GATE
from stages.hypotheses import ELAPSED
from stages.isolate import Isolate
from stages.pair_search import Pair, Search, begun, refined, sought
from stages.rarer import ONE, UNSEEN, Alone, Also, Rarer
from stages.results import DETECTION, EVIDENCE, OF, PAIR, PROBABILITY, SENSOR, SIZE, SIZE_SD, UNKNOWN
from stages.stage import ANALYSIS, Stage, add_columns, columns

Array = NDArray[np.float64]
FIRST, GROWTH = 20, 2.5  # samples of an alarm before pairs are looked at, and after which factor again
FEW, SOME = 50, 100  # samples to find two sizes by, and whether there are two
MIRRORED = 0.3  # of its size
UNSURE = 2.0  # at most: large faults are not the least sure
STANDS_FOR = "stands_for"  # s
NOTHING = Pair(-np.inf, -np.inf, 0.0, (np.nan, np.nan), (np.nan, np.nan))


@dataclass(frozen=True, eq=False)
class PairsState:
    """Of the alarm's usable samples every so many, how many there were, when to look again, the time of the
    log's first row and of the last, and what was found: pairs, and the rarer faults."""

    samples: Mapping[str, Array] = field(default_factory=dict)
    count: int = 0
    due: int = FIRST
    first: float = np.nan
    time: float = np.nan
    found: Mapping[str, Pair] = field(default_factory=dict)
    rare: Mapping[str, Alone] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """``faults``: those that can occur together, none for all of the stage before; ``penalty``: how much
    likelier than a single fault a pair must be (natural logarithm); ``model_error``: the part of a pair's
    evidence over a single fault by which evidence may be wrong; ``alike``: faults any two of which look the
    same, so that their pairs share their probability; ``rows``: samples to look at, at most; ``also``: rarer
    faults by the sensor that can have them (:mod:`stages.rarer`), with ``also_penalty``.

    Raises:
        RecipeError: the stage before is not `isolate`, or has no such fault.
    """

    version: ClassVar[str] = "13"
    faults: tuple[str, ...] = ()
    penalty: float = 10.0
    model_error: float = 0.03
    alike: tuple[tuple[str, ...], ...] = ()
    rows: int = 400
    also: Also = field(default_factory=dict)
    also_penalty: float = 5.0
    before: tuple[Stage, ...] = ()

    @property
    def needs(self) -> set[str]:
        return {DETECTION}

    @property
    def adds(self) -> set[str]:
        names = [*self.also, *(self.pairs if self.before else ())]
        sensors = {SENSOR + f + OF + signal for f, some in self.also.items() for signal in some}
        return sensors | {kind + name for name in names for kind in (PROBABILITY, EVIDENCE)}

    def connect(self, before: Sequence[Stage], /) -> Self:
        return replace(self, before=tuple(before))

    @cached_property
    def isolate(self) -> Isolate:
        if not self.before or not isinstance(self.before[-1], Isolate):
            raise RecipeError("pairs: put it right after the stage isolate")
        isolate = self.before[-1]
        for fault in {*self.faults}.union(*self.alike) - isolate.hypotheses.keys():
            raise RecipeError(
                f"pairs: no fault {fault!r} in isolate; {did_you_mean(fault, isolate.hypotheses)}"
            )
        return isolate

    @cached_property
    def pairs(self) -> dict[str, tuple[str, str]]:
        """Two faults by their common name, a sensor's first, as at least one is."""
        hypotheses = {f: h for f, h in self.isolate.hypotheses.items() if not self.faults or f in self.faults}
        out = {}
        for a, b in combinations(sorted(hypotheses, key=lambda f: (hypotheses[f].signal is None, f)), 2):
            apart = hypotheses[a].undo.keys().isdisjoint(hypotheses[b].undo)
            if apart and hypotheses[a].signal is not None:
                out[PAIR.join(sorted((a, b)))] = (a, b)
        return out

    @cached_property
    def rarer(self) -> Rarer | None:
        """The rarer faults, if there are any."""
        return Rarer.of(self.also, self.isolate) if self.also else None

    def start(self) -> PairsState:
        return PairsState()

    def step(self, state: PairsState, block: Log, /) -> tuple[PairsState, Log]:
        time, values = block.groups[ANALYSIS].time, columns(block)
        if not time.size:
            return state, add_columns(block, self._columns(values, {}, {}))
        state = replace(state, first=state.first if np.isfinite(state.first) else float(time[0]))
        dt = np.diff(time, prepend=state.time)
        on = values[DETECTION] > 0
        gate = np.nan_to_num(values.get(GATE, np.ones(time.size)), nan=0.0)
        usable = on & (gate >= self.isolate.min_gate)
        dt = np.where(np.isfinite(dt), dt, self.isolate.correlation_s)
        rarer = self.rarer.points.needs if self.rarer else set()
        wanted = {TIME, GATE, *rarer, *self.isolate.needs, *self.isolate.points.needs} & values.keys()
        samples = {c: values[c] for c in wanted} | {ELAPSED: time - state.first, STANDS_FOR: dt}
        found: dict[int, Mapping[str, Pair]] = {0: state.found}  # from a row on
        rare: dict[int, Mapping[str, Alone]] = {0: state.rare}
        for a, b in pairwise([0, *(np.flatnonzero(np.diff(on)) + 1).tolist(), time.size]):
            if not on[a]:
                state, found[a], rare[a] = PairsState(first=state.first), {}, {}
                continue
            new = a + np.flatnonzero(usable[a:b])
            while new.size:
                seen = min(state.due - state.count, new.size)
                state = self._seen(state, samples, new[:seen])
                if state.count == state.due:
                    k = int(new[seen - 1])
                    found[k], rare[k] = self._judged(self._window(state), state.found)
                    due = int(np.ceil(GROWTH * state.due))
                    state = replace(state, due=due, found=found[k], rare=rare[k])
                new = new[seen:]
        return replace(state, time=float(time[-1])), add_columns(block, self._columns(values, found, rare))

    def _apart(self, count: int) -> int:
        """One in how many of an alarm's first ``count`` samples is kept."""
        return 1 << max(0, int(np.ceil(np.log2(max(count, 1) / self.rows))))

    def _seen(self, state: PairsState, samples: Mapping[str, Array], new: NDArray[np.intp]) -> PairsState:
        """The state after rows ``new``; which samples are kept depends on their number in the alarm alone."""
        count, old = state.count + new.size, state.samples
        apart = self._apart(count)
        fewer = apart // self._apart(state.count)
        new = new[np.arange(state.count, count) % apart == 0]
        kept = {c: np.concatenate([old[c][::fewer] if old else [], x[new]]) for c, x in samples.items()}
        return replace(state, samples=kept, count=count)

    def _window(self, state: PairsState) -> Window:
        isolate, samples = self.isolate, dict(state.samples)
        points, shapes = isolate.points, isolate.shapes(samples, isolate.points.residuals)
        weight = isolate.weight(self._apart(state.count) * samples[STANDS_FOR])
        return Window(points, isolate.grid, samples, shapes, isolate.sd, weight, isolate.clip)

    def _judged(
        self, window: Window, before: Mapping[str, Pair]
    ) -> tuple[Mapping[str, Pair], Mapping[str, Alone]]:
        """The pairs and the rarer faults that are more evident than one usual fault."""
        some, rare = window.thinned(SOME), dict[str, Alone]()
        if self.rarer:
            rare = self.rarer.compared(some, self.isolate, self.also_penalty)
        return self._search(window, some, before), rare

    def _search(self, window: Window, some: Window, before: Mapping[str, Pair]) -> dict[str, Pair]:
        """The pairs that say more than any single fault, their sizes refined; ``height`` is by how much;
        ``some`` of the samples are to find them; ``before``: those that were found by then. A fault that is
        smaller than the smallest size of its grid is none."""
        isolate, names = self.isolate, [*self.isolate.hypotheses]
        place = {f: k for k, f in enumerate(names)}
        least = {f: 0.99 * min(map(abs, h.sizes)) for f, h in isolate.hypotheses.items()}
        about = {
            pair: some.additive.pair(place[a], place[b], (least[a], least[b]))
            for pair, (a, b) in self.pairs.items()
        }
        near = {pair for pair, x in before.items() if x.height > -self.penalty}
        if not near and max((gain for gain, _ in about.values()), default=0.0) < self.penalty:
            return {}
        starts = {
            pair: [at, *(x.sizes for x in (before.get(pair),) if x)]
            for pair, (gain, at) in about.items()
            if gain > -self.penalty or pair in near
        }
        named = int(np.argmax([height for _, height in window.singles]))
        single, size = names[named], window.singles[named][0]
        found = {
            pair: x
            for pair, x in self._refined(window, some.thinned(FEW), starts).items()
            if all(abs(s) >= least[f] for s, f in zip(x.sizes, self.pairs[pair], strict=True))
            and not self._mirrors(pair, x, single, size)
        }
        if not found:
            return {}
        which = np.array([self._numbers[pair] for pair in found])
        sizes = np.array([x.sizes for x in found.values()])
        familiar = window.familiar(which, sizes, isolate.known_to)
        best = max(familiar.most + self.penalty, familiar.alone)
        unknown = familiar.unknown(isolate.wide_sd) - isolate.unknown_penalty + best - familiar.most
        L = familiar.both(which, sizes) + [x.share for x in found.values()]
        return {
            pair: replace(x, height=height - best, over_unknown=height - unknown)
            for (pair, x), height in zip(found.items(), L.tolist(), strict=True)
        }

    @cached_property
    def _numbers(self) -> dict[str, tuple[int, int]]:
        """Of every pair the hypotheses' numbers among the points'."""
        place = {f: len(self.isolate.drifts) + k for k, f in enumerate(self.isolate.hypotheses)}
        return {pair: (place[a], place[b]) for pair, (a, b) in self.pairs.items()}

    def _refined(
        self, window: Window, few: Window, starts: Mapping[str, Sequence[tuple[float, float]]]
    ) -> dict[str, Pair]:
        """The likeliest sizes of the pairs of ``starts``, found on ``few`` samples from there and from the
        grid's, then refined."""
        hypotheses = self.isolate.hypotheses
        alone = {f: few.singles[k][0] for k, f in enumerate(hypotheses)}
        sizes = {f: [*h.sizes[::5], alone[f]] for f, h in hypotheses.items()}
        both = {pair: (hypotheses[a], hypotheses[b]) for pair, (a, b) in self.pairs.items()}
        searches = {}
        for pair, some in starts.items():
            (a, b), (first, second) = self.pairs[pair], zip(*some, strict=True)
            steps = begun(both[pair], [*sizes[a], *first], [*sizes[b], *second])
            searches[pair] = Search(self._numbers[pair], steps)
        found = sought(few, searches)
        again = {pair: Search(self._numbers[pair], refined(both[pair], x, 2)) for pair, x in found.items()}
        return sought(window, again)

    def _mirrors(self, pair: str, found: Pair, single: str, size: float) -> bool:
        """Whether a pair only says in other words that one fault of those alike has a ``size``: the two
        others have about its opposite."""
        faults = {*self.pairs[pair], single}
        alike = len(faults) == 3 and any(faults <= {*group} for group in self.alike)
        return alike and all(abs(x + size) <= MIRRORED * abs(size) for x in found.sizes)

    def _columns(
        self,
        values: Mapping[str, Array],
        found: Mapping[int, Mapping[str, Pair]],
        rare: Mapping[int, Mapping[str, Alone]],
    ) -> dict[str, NDArray[Any]]:
        """Evidence, probabilities and sizes of all pairs, and the probabilities of all else among them."""
        temper, singles = self.isolate.temper, [*self.isolate.hypotheses, UNKNOWN]
        evidence = {f: values[EVIDENCE + f] for f in singles}
        best = np.max([evidence[f] for f in singles[:-1]], axis=0)
        lasting = np.diff([*found, len(best)])  # rows
        added: dict[str, NDArray[Any]] = {}
        one = np.repeat([known.get(ONE, UNSEEN).over_unknown for known in rare.values()], lasting)
        judged = np.isfinite(one)
        evidence[UNKNOWN] = np.where(judged, np.minimum(evidence[UNKNOWN], best - one), evidence[UNKNOWN])
        for pair, faults in self.pairs.items():
            pairs = [known.get(pair, NOTHING) for known in found.values()]
            over, wide = (
                np.repeat([getattr(x, of) for x in pairs], lasting) for of in ("height", "over_unknown")
            )
            evidence[pair] = np.maximum(best + over, np.where(judged, evidence[UNKNOWN] + wide, -np.inf))
            added[EVIDENCE + pair] = np.maximum(evidence[pair], best - self.penalty).astype(np.float32)
            for k, fault in enumerate(faults):
                named, x = pair + OF + fault, np.array([(x.sizes[k], x.sds[k]) for x in pairs]).reshape(-1, 2)
                for c, kind in enumerate((SIZE, SIZE_SD)):
                    added[kind + named] = np.repeat(x[:, c], lasting).astype(np.float32)
        for fault, some in self.also.items():
            for name in (fault + OF + signal for signal in some):
                alone = [known.get(name, UNSEEN) for known in rare.values()]
                over, wide, size, sd = (
                    np.repeat([getattr(x, of) for x in alone], lasting)
                    for of in ("height", "over_unknown", "size", "sd")
                )
                evidence[name] = np.maximum(best + over, evidence[UNKNOWN] + wide)
                added[SENSOR + name] = np.maximum(evidence[name], best - self.also_penalty).astype(np.float32)
                added |= {SIZE + name: size.astype(np.float32), SIZE_SD + name: sd.astype(np.float32)}
            added[EVIDENCE + fault] = np.max([added[SENSOR + fault + OF + s] for s in some], axis=0)
        on = values[DETECTION] > 0
        x = np.array([*evidence.values()])
        gain = np.maximum(x[len(singles) :].max(axis=0) - best, 0.0)
        inexact = np.array([h.inexact for h in self.isolate.hypotheses.values()])
        unsure = np.clip(inexact[x[: len(inexact)].argmax(axis=0)] ** 2 * best, 0.0, UNSURE)
        x *= temper / (1.0 + self.model_error * gain + unsure)
        odds = np.where(on, np.exp(x - x.max(axis=0)), 0.0)
        p = odds / np.maximum(odds.sum(axis=0), 1e-300)
        for group in self.alike:
            same = [i for i, f in enumerate(evidence) if {*f.split(PAIR)} <= {*group} and PAIR in f]
            p[same] = p[same].mean(axis=0)
        share = dict(zip(evidence, p, strict=True))
        for fault, some in self.also.items():
            share[fault] = np.sum([share.pop(fault + OF + s) for s in some], axis=0)
        return added | {PROBABILITY + f: row.astype(np.float32) for f, row in share.items()}
