"""Pairs: two faults at once, where one alone leaves something unexplained.

After the stage `isolate`, on the last ``rows`` usable samples of an alarm, whenever the alarm has three times
as many as before. A sensor's fault and another of ``faults`` are undone one after the other at a few sizes
and on a few samples. Where no second fault adds to the likeliest one, that is all. Else Newton's steps on the
log-likelihood L (:mod:`stages.likelihood`) find both sizes. With d the standard deviation of a size, C the
covariance of the two, and f* the best single fault,

    evidence_fg = evidence_f* + L_fg + ln(2 pi |C|^1/2 / ranges) - max(L_f* + least, L_h),
    L_f* = max_f [L_f + ln(sqrt(2 pi) d / range)],

where least is ``penalty`` and ``least_share`` of what f* explains of the log as it is, and L_h that of the
best single fault whose size changes once within the samples: one fault that grows or ends is not two. The
probabilities are those of the stage before, with the pairs among the suppositions. Where a pair explains
much, errors of the relations explain more, too: all evidence then counts ``1 / (1 + model_error gain)``. Two
faults at once are a requirement of section 1.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, did_you_mean
from ingest.log import TIME, Log
from stages.gate import GATE
from stages.hypotheses import ELAPSED
from stages.isolate import Isolate
from stages.pair_search import Pair, Window
from stages.rarer import ONE, UNSEEN, Alone, Also, Rarer
from stages.results import DETECTION, EVIDENCE, OF, PAIR, PROBABILITY, SENSOR, SIZE, SIZE_SD, UNKNOWN
from stages.stage import ANALYSIS, Stage, add_columns, columns

Array = NDArray[np.float64]
FIRST, GROWTH = 20, 3.0  # samples of an alarm before pairs are looked at, and after which factor again
REFINED, FEW, SOME = 12, 50, 200  # pairs at most, samples to find them and rarer faults by
STANDS_FOR = "stands_for"  # s
NOTHING = Pair(-np.inf, -np.inf, 0.0, (np.nan, np.nan), (np.nan, np.nan))


@dataclass(frozen=True, eq=False)
class PairsState:
    """The alarm's last usable samples, how many there were, when to look again, the time of the log's first
    row and of the last, and what was found: pairs, and the rarer faults."""

    samples: Mapping[str, Array] = field(default_factory=dict)
    count: int = 0
    due: int = FIRST
    first: float = np.nan
    time: float = np.nan
    found: Mapping[str, Pair] = field(default_factory=dict)
    rare: Mapping[str, Alone] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """``faults``: those that can occur together, none for all of the stage before; ``penalty``,
    ``least_share``: how much likelier than a single fault a pair must be (natural logarithm), and which part
    of what that explains; ``model_error``: the part of a pair's evidence over a single fault by which
    evidence may be wrong; ``alike``: faults any two of which look the same, so that their pairs share their
    probability; ``rows``: samples to look at; ``also``: rarer faults by the sensor that can have them
    (:mod:`stages.rarer`), with ``also_penalty``.

    Raises:
        RecipeError: the stage before is not `isolate`, or has no such fault.
    """

    version: ClassVar[str] = "7"
    faults: tuple[str, ...] = ()
    penalty: float = 10.0
    least_share: float = 0.0007
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
        taken = 0
        for k in np.flatnonzero(on | np.append(True, on[:-1])).tolist():
            if not on[k]:
                state, taken, found[k] = PairsState(first=state.first), k + 1, {}
                rare[k] = {}
            elif usable[k]:
                state = replace(state, count=state.count + 1)
                if state.count >= state.due:
                    kept = self._kept(state, samples, usable, slice(taken, k + 1))
                    taken = k + 1
                    due = int(np.ceil(GROWTH * state.count))
                    found[k], rare[k] = self._judged(self._window(kept))
                    state = replace(state, samples=kept, due=due, found=found[k], rare=rare[k])
        kept = self._kept(state, samples, usable, slice(taken, time.size))
        state = replace(state, samples=kept, time=float(time[-1]))
        return state, add_columns(block, self._columns(values, found, rare))

    def _kept(
        self, state: PairsState, samples: Mapping[str, Array], usable: NDArray[np.bool_], rows: slice
    ) -> dict[str, Array]:
        """The last usable samples, with those of ``rows``."""
        new = {c: x[rows][usable[rows]] for c, x in samples.items()}
        old = state.samples
        return {
            c: np.concatenate([old[c], x])[-self.rows :] if old else x[-self.rows :] for c, x in new.items()
        }

    def _window(self, samples: dict[str, Array]) -> Window:
        isolate = self.isolate
        points, shapes = isolate.points, isolate.shapes(samples, isolate.points.residuals)
        weight = isolate.weight(samples[STANDS_FOR])
        return Window(points, isolate.grid, samples, shapes, isolate.sd, weight, isolate.clip)

    def _judged(self, window: Window) -> tuple[Mapping[str, Pair], Mapping[str, Alone]]:
        """The pairs and the rarer faults that are more evident than one usual fault."""
        rare: Mapping[str, Alone] = {}
        if self.rarer:
            some = window.thinned(SOME)
            penalty = self.also_penalty + self._least(some) - self.penalty
            rare = self.rarer.compared(some, self.isolate, penalty)
        # where another kind of fault says more than one of the usual ones, two of these may, too
        return self._search(window, all_of_them=any(x.height > 0 for x in rare.values())), rare

    def _least(self, window: Window) -> float:
        """How much likelier than one fault two must be."""
        return self.penalty + self.least_share * window.explained

    def _search(self, window: Window, *, all_of_them: bool) -> dict[str, Pair]:
        """The pairs that say more than any single fault, their sizes refined; ``height`` is by how much."""
        isolate = self.isolate
        few, drifts, names = window.thinned(FEW), len(isolate.drifts), [*isolate.hypotheses]
        place = {f: drifts + k for k, f in enumerate(names)}
        single = {f: size for f, (size, _) in zip(names, few.singles, strict=True)}
        sizes = {f: [*isolate.hypotheses[f].sizes[::3], single[f]] for f in names}
        likeliest = names[int(np.argmax([height for _, height in few.singles]))]
        starts: dict[str, tuple[float, tuple[float, float]]] = {}
        enough = few.most + 0.5 * self._least(few)
        # those with the likeliest fault first: where nothing adds to it, one fault is enough
        for pair in sorted(self.pairs, key=lambda p: likeliest not in self.pairs[p]):
            a, b = self.pairs[pair]
            if likeliest not in (a, b) and starts and not all_of_them and _most(starts) < enough:
                return {}
            starts[pair] = few.start(place[a], place[b], sizes[a], sizes[b])
        likely = sorted((p for p in starts if starts[p][0] > few.most), key=lambda p: -starts[p][0])
        at: dict[str, tuple[int, int, Pair]] = {}
        for pair in likely[:REFINED]:
            i, j = (place[f] for f in self.pairs[pair])
            at[pair] = i, j, window.refined(i, j, few.refined(i, j, starts[pair][1], 8), 2)
        if not at:
            return {}
        familiar = window.familiar(list(at.values()), isolate.known_to)
        best = max(familiar.most + self._least(familiar), familiar.alone)
        unknown = familiar.unknown(isolate.wide_sd) - isolate.unknown_penalty + best - familiar.most
        found = {}
        for pair, (i, j, x) in at.items():
            L = familiar.both(i, j, np.array([x.sizes]))[0] + x.share
            found[pair] = replace(x, height=L - best, over_unknown=L - unknown)
        return found

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
        x *= temper / (1.0 + self.model_error * np.maximum(x[len(singles) :].max(axis=0) - best, 0.0))
        odds = np.where(on, np.exp(x - x.max(axis=0)), 0.0)
        p = odds / np.maximum(odds.sum(axis=0), 1e-300)
        for group in self.alike:
            same = [i for i, f in enumerate(evidence) if {*f.split(PAIR)} <= {*group} and PAIR in f]
            p[same] = p[same].mean(axis=0)
        share = dict(zip(evidence, p, strict=True))
        for fault, some in self.also.items():
            share[fault] = np.sum([share.pop(fault + OF + s) for s in some], axis=0)
        return added | {PROBABILITY + f: row.astype(np.float32) for f, row in share.items()}


def _most(starts: Mapping[str, tuple[float, tuple[float, float]]]) -> float:
    return max(L for L, _ in starts.values())
