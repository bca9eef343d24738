"""Hypotheses: what the log would read if a supposed fault of a supposed size were undone.

A hypothesis says how to correct the columns for a fault of size ``theta``: ``W_HFM = "W_HFM / (1 + theta)"``
for an air mass flow sensor that reads ``1 + theta`` times the truth. Residuals are then computed from the
corrected columns. The right correction brings the data back to where the relations were trained, so neither
they nor their domain are asked for more than they know.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.formula import Formula
from stages.relations import Relations
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA, UNFAMILIAR
from stages.stage import RowWise

Array = NDArray[np.float64]
THETA, ELAPSED, OFFSET = "theta", "elapsed", "offset."
Evaluated = tuple[Array, Array, Array, Array]
CHUNK = 1 << 17  # rows times hypotheses computed at once: bounds memory


@dataclass(frozen=True, kw_only=True)
class Hypothesis:
    """``undo`` maps a column to the formula that corrects it for size ``theta``; ``elapsed`` is s since the
    log's start.

    ``sizes``: the grid of sizes to try, in ``unit`` (``"1"``, ``"mm"``, ``"%"``); ``signal``: the sensor
    concerned, if one; ``from_zero``: size 0 is being healthy, which is not so for a stuck valve; ``inexact``:
    the part of what undoing changes in a residual that may be wrong (standard deviation); ``blur``: the part
    that may be wrong in a regime alone, a formula of a sample's columns and of ``offset.<r>``, the standard
    deviation of a residual's offset.

    Raises:
        RecipeError: no correction or no sizes, sizes that do not rise or hold 0 though that is healthy, or a
            formula that cannot be read.
    """

    undo: Mapping[str, str]
    sizes: tuple[float, ...]
    unit: str = "1"
    signal: str | None = None
    from_zero: bool = True
    inexact: float = 0.0
    blur: str = "0"

    def __post_init__(self) -> None:
        s = self.sizes
        if not self.undo or not s or (self.from_zero and 0.0 in s) or any(b <= a for a, b in pairwise(s)):
            raise RecipeError(
                "a hypothesis needs `undo` and rising `sizes` without 0, "
                f"got undo = {dict(self.undo)}, sizes = {list(s)}"
            )
        assert self.formulas is not None
        assert self.blurred is not None

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        return {name: Formula(text) for name, text in self.undo.items()}

    @cached_property
    def blurred(self) -> Formula:
        return Formula(self.blur)

    @property
    def needs(self) -> set[str]:
        formulas = [*self.formulas.values(), self.blurred]
        names = {*self.undo}.union(*(f.names for f in formulas))
        return {n for n in names if n not in (THETA, ELAPSED) and not n.startswith(OFFSET)}


@dataclass(frozen=True, kw_only=True)
class Drift:
    """A change that healthy systems show too, such as a cold sensor: ``undo`` as in :class:`Hypothesis`, with
    ``theta ~ N(0, sd^2)``."""

    undo: Mapping[str, str]
    sd: float

    def hypothesis(self) -> Hypothesis:
        """The drift on a grid of -2 to 2 standard deviations."""
        return Hypothesis(undo=self.undo, sizes=tuple(self.sd * x for x in DRIFT_GRID))


DRIFT_GRID = (-2.0, -1.0, 1.0, 2.0)  # standard deviations, and the probability of being nearest to each
DRIFT_PRIOR = (0.0668, 0.2417, 0.2417, 0.0668)


@dataclass(frozen=True, eq=False)
class Points:
    """All (hypothesis, size) pairs to evaluate, the first being the log as it is."""

    hypotheses: Sequence[Hypothesis]
    chain: Sequence[RowWise]
    residuals: Sequence[str]

    @property
    def count(self) -> int:
        return 1 + sum(map(len, self.sizes))

    @cached_property
    def sizes(self) -> list[tuple[float, ...]]:
        """Of every hypothesis those to evaluate: none where all relations that it concerns were never learned
        (no exhaust gas recirculation, no valve that sticks), as it then looks like the log as it is."""
        stages = [(k, stage) for k, stage in enumerate(self.chain) if isinstance(stage, Relations)]
        sizes = []
        for h, plan in zip(self.hypotheses, self._plans, strict=True):
            concerned = {n for k, stage in stages for n in plan[k] & stage.relations.keys()}
            learned = concerned.intersection(*(stage.models for _, stage in stages))
            sizes.append(h.sizes if learned or not concerned else ())
        return sizes

    def place(self, fault: int) -> slice:
        """The points of a hypothesis."""
        start = 1 + sum(map(len, self.sizes[:fault]))
        return slice(start, start + len(self.sizes[fault]))

    @cached_property
    def needs(self) -> set[str]:
        """Columns that the chain and the corrections read and the chain does not make."""
        needed, made = set[str](), set[str]()
        for stage in self.chain:
            needed |= stage.needs - made
            made |= stage.adds
        return needed.union(*(h.needs for h in self.hypotheses))

    @cached_property
    def _plans(self) -> list[list[set[str]]]:
        """By hypothesis and stage, the columns to compute anew: those that the residuals need and that are
        made, at however many removes, from what the hypothesis corrects."""
        goal = {kind + r for kind in (RESIDUAL, SIGMA, MODEL_SD, UNFAMILIAR) for r in self.residuals}
        plans = []
        for h in self.hypotheses:
            changed, plan = {*h.undo}, []
            for stage in self.chain:
                before = {*changed}
                for column, made_from in stage.sources().items():
                    if not changed.isdisjoint(made_from):
                        changed.add(column)
                plan.append(changed - before)
            needed = {*goal}
            for columns, stage in zip(reversed(plan), reversed(self.chain), strict=True):
                for column, made_from in reversed([*stage.sources().items()]):
                    if column in columns and column in needed:
                        needed |= made_from
                columns &= needed
            plans.append(plan)
        return plans

    def evaluate(self, values: Mapping[str, Array], elapsed: Array) -> Evaluated:
        """As :meth:`evaluated`, from what the chain and the corrections read."""
        step = max(1, CHUNK // self.count)
        found = self._empty(len(elapsed))
        for k in range(0, len(elapsed), step):
            rows = slice(k, k + step)
            base = self.as_it_is({c: x[rows] for c, x in values.items()}, elapsed[rows])
            self._fill(base, *(x[rows] for x in found))
        return found

    def evaluated(self, base: Mapping[str, Array]) -> Evaluated:
        """Residuals, their spreads and the doubts of their relations, each (rows, residuals, points); and the
        least novelty that any point gives them, shape (rows, residuals); from :meth:`as_it_is`."""
        found = self._empty(base[ELAPSED].size)
        self._fill(base, *found)
        return found

    def _empty(self, rows: int) -> Evaluated:
        R = len(self.residuals)
        e, sigma, doubt = (np.empty((rows, R, self.count)) for _ in range(3))
        return e, sigma, doubt, np.full((rows, R), np.inf)

    def _fill(self, base: Mapping[str, Array], e: Array, sigma: Array, doubt: Array, novelty: Array) -> None:
        place, computed, inexact = slice(0, 1), base, 0.0
        for i in range(len(self.hypotheses) + 1):
            if i > 0:
                sizes = np.array(self.sizes[i - 1])[:, None]
                if not sizes.size:
                    continue
                place = slice(place.stop, place.stop + len(sizes))
                computed = self.undone(base, np.full(sizes.shape, i - 1), sizes)
                inexact = self.hypotheses[i - 1].inexact
            for r, name in enumerate(self.residuals):
                there, sd = computed[RESIDUAL + name], computed[MODEL_SD + name]
                if inexact > 0.0 and there is not base[RESIDUAL + name]:
                    wrong = inexact * (there - base[RESIDUAL + name])
                    sd = np.sqrt(sd * sd + wrong * wrong)
                e[:, r, place] = there.T
                sigma[:, r, place] = computed[SIGMA + name].T
                doubt[:, r, place] = sd.T
                least = np.fmin.reduce(computed[UNFAMILIAR + name], axis=0)
                np.fmin(novelty[:, r], least, out=novelty[:, r])

    def as_it_is(self, values: Mapping[str, Array], elapsed: Array) -> dict[str, Array]:
        """The log's and the chain's columns, shape (1, rows)."""
        base = {c: x[None, :] for c, x in values.items()} | {ELAPSED: elapsed[None, :]}
        for stage in self.chain:
            base |= stage.compute(base)
        return base

    def undone(self, base: Mapping[str, Array], which: NDArray[np.intp], sizes: Array) -> dict[str, Array]:
        """The chain's columns at K points, at each of them the hypotheses of the numbers ``which`` (K, any)
        undone at their ``sizes`` (K, any), one after the other: shape (K, rows), or (1, rows) where a column
        is the same for all."""
        found, numbers = dict(base), np.unique(which).tolist()
        for faults, theta in zip(which.T, sizes.T, strict=True):
            for i in numbers:
                if (at := faults == i).any():
                    found |= self._corrected(found, i, at, theta[at])
        undone = set[str]().union(*(self.hypotheses[i].undo for i in numbers))
        for k, stage in enumerate(self.chain):
            if wanted := set[str]().union(*(self._plans[i][k] for i in numbers)):
                computed = stage.compute(found, wanted)
                for column in undone & computed.keys():  # where it was undone itself, it stays so
                    of = [i for i in numbers if column in self.hypotheses[i].undo]
                    stays = np.isin(which, of).any(axis=1, keepdims=True)
                    computed[column] = np.where(stays, found[column], computed[column])
                found |= computed
        return found

    def _corrected(
        self, found: Mapping[str, Array], i: int, at: NDArray[np.bool_], sizes: Array
    ) -> dict[str, Array]:
        """The columns that hypothesis ``i`` undoes, undone at some of the points."""
        h = self.hypotheses[i]
        scope = at_points(found, {*h.needs, ELAPSED}, at) | {THETA: sizes[:, None]}
        undone = {column: formula(scope) for column, formula in h.formulas.items()}
        if at.all():
            return undone
        out = {}
        for column, x in undone.items():
            out[column] = np.array(np.broadcast_to(found[column], (len(at), found[ELAPSED].shape[1])))
            out[column][at] = x
        return out


def at_points(found: Mapping[str, Array], names: Set[str], at: NDArray[np.bool_]) -> dict[str, Array]:
    """Columns, (points, rows) or (1, rows), at some of the points."""
    return {n: found[n] if len(found[n]) == 1 else found[n][at] for n in names & found.keys()}
