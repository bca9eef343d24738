"""Descent: the gene whose own smoothly blended model has the shortest description.

The score of a gene with n of K candidates is ``S + (2 ln K + ln N) n``, S of :mod:`stages.blended` in the
gene's own regressors: what the model leaves unexplained, what it costs to describe its coefficients, and
which regressors it has. One rule serves linear and strongly nonlinear systems, long and short logs.

1. Shortlist: the best genes of the exact tables (:mod:`stages.exhaustive`) of common partitions in 1, 4, 8
   and 16 regions.
2. Every other value of each variable's part of the best gene, at its number of centres; the most promising
   ones are scored in full. Again, until nothing is better.
3. The table of a partition in the gene's own regressors, in its metric, in 8 and 32 regions; if that shows a
   better gene, back to 2. So too if the two candidates whose product explains most of what is left help.
4. If others are close, the best genes once more with more effort.

The result is locally optimal. Every score is kept, so that none is computed twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from stages.blended import Blended, fit_blended, fit_centres
from stages.coordinate import coordinate
from stages.criteria import score_of
from stages.exhaustive import exhaustive
from stages.genes import Space
from stages.gram import Gram, of_regions
from stages.tree import nested_centres

Array = NDArray[np.float64]
WALKED = 300_000  # genes: larger tables are searched, not walked
TABLES = (0, 2, 3, 4)  # levels of the common partitions: 1, 4, 8, 16 regions
OWN_TABLES = (3, 5)
BEST = 3  # genes taken from each table
PROMISING = 4  # genes of a check that are scored in full
SCREENED = 4  # level of centres at most at which genes are compared before they are scored in full
SLACK = 0.05  # per row, by which a gene may then be worse
HOPELESS = 1.0  # per row, by which a gene may be worse than one with more regressors, in the same metric
PAIRS = 4  # products of candidates that are tried
RIVALS = 3  # genes compared with more effort in the end
ROUNDS = 20


@dataclass(eq=False)
class Scorer:
    """Scores of genes for standardised ``rows`` (N, K + 1), the output last."""

    space: Space
    rows: Array
    scores: dict[int, float] = field(default_factory=dict)
    models: dict[int, Blended | None] = field(default_factory=dict)
    screens: dict[tuple[int, int], float] = field(default_factory=dict)

    @property
    def price(self) -> float:
        N, K = len(self.rows), self.rows.shape[1] - 1
        return float(2 * np.log(K) + np.log(N))

    @property
    def y(self) -> Array:
        return self.rows[:, -1]

    def regressors(self, gene: int) -> Array:
        return self.rows[:, list(self.space.columns(gene))]

    def __call__(self, gene: int) -> float:
        if gene not in self.scores:
            X, y = self.regressors(gene), np.ascontiguousarray(self.y)
            if X.shape[1]:
                self.models[gene] = model = fit_blended(X, y)
                self.scores[gene] = model.S + self.price * X.shape[1]
            else:
                self.models[gene] = None
                self.scores[gene] = float(len(y) * np.log(y @ y / len(y)) + np.log(len(y) + 1))
        return self.scores[gene]

    def refine(self, gene: int, whole: int) -> None:
        """Score a gene again, beginning with the metric of one that has all its regressors."""
        columns, model = self.space.columns(gene), self.models[whole]
        if model is None or model.M == 1 or not columns:
            self(gene)
            return
        rows = [self.space.columns(whole).index(c) for c in columns]
        X, y = self.regressors(gene), np.ascontiguousarray(self.y)
        hopeless = model.S + HOPELESS * len(y)
        self.offer(gene, fit_blended(X, y, start=replace(model, T=model.T[rows]), hopeless=hopeless))

    def offer(self, gene: int, model: Blended) -> None:
        """Take a model of a gene's regressors if it is the best so far."""
        score = model.S + self.price * len(self.space.columns(gene))
        if gene not in self.scores or score < self.scores[gene]:
            self.scores[gene], self.models[gene] = score, model

    def best(self) -> int:
        return min(self.scores, key=lambda g: self.scores[g])

    def screened(self, gene: int, level: int) -> float:
        """The score at one number of centres, without a metric."""
        if (gene, level) not in self.screens:
            X = self.regressors(gene)
            if not X.shape[1]:
                return self(gene)
            centres = nested_centres(X, level)[-1]
            model = fit_centres(X, np.ascontiguousarray(self.y), centres, np.eye(X.shape[1]))
            self.screens[gene, level] = model.S + self.price * X.shape[1]
        return self.screens[gene, level]

    def race(self, genes: Iterable[int], level: int, than: int | None = None) -> None:
        """Score the most promising of ``genes`` in full, of those that are not much worse than ``than``."""
        ranked = sorted({*genes} - self.scores.keys(), key=lambda g: self.screened(g, level))[:PROMISING]
        limit = np.inf if than is None else self.screened(than, level) + SLACK * len(self.rows)
        for gene in ranked:
            if self.screened(gene, level) < limit:
                self(gene)


def descend(space: Space, rows: Array, start: Sequence[int] = ()) -> Scorer:
    """Search ``space`` for ``rows`` (N, K + 1), standardised; what comes back knows the best gene and every
    score that was computed. ``start``: further genes to begin from."""
    scorer = Scorer(space, rows)
    common = nested_centres(rows[:, :-1], max(TABLES))
    tables = [g for level in TABLES for g in _table(space, rows, rows[:, :-1], common, level)]
    scorer.race((*start, *tables), SCREENED)
    for _ in range(ROUNDS):
        _check_blocks(scorer)
        gene = scorer.best()
        model = scorer.models[gene]
        if model is None:
            scorer.race(_products(scorer, gene, None), SCREENED)
            if scorer.best() == gene:
                break
            continue
        XT = scorer.regressors(gene) @ model.T
        own = nested_centres(XT, max(OWN_TABLES))
        tables = [g for level in OWN_TABLES for g in _table(space, rows, XT, own, level)]
        scorer.race(tables, _level(model), gene)
        scorer.race(_products(scorer, gene, model), SCREENED, gene)
        if scorer.best() == gene:
            break
    _duel(scorer)
    return scorer


def _products(scorer: Scorer, gene: int, model: Blended | None) -> list[int]:
    """The gene with the two candidates whose product explains most of what its model leaves, for the best
    few: regressors that say nothing alone are found together."""
    left = scorer.y if model is None else scorer.y - model.predict(scorer.regressors(gene))
    X = scorer.rows[:, :-1]
    share = np.abs((X * left[:, None]).T @ X)
    mine = scorer.space.columns(gene)
    share[np.ix_(mine, mine)] = 0.0
    pairs = np.argsort(np.triu(share), axis=None)[::-1][:PAIRS]
    found = [_extended(scorer.space, gene, divmod(int(p), X.shape[1])) for p in pairs]
    return [g for g in found if g is not None]


def _extended(space: Space, gene: int, more: Iterable[int]) -> int | None:
    """The smallest gene that also has the candidates ``more``, None where the bounds do not allow it."""
    wanted, options = {*space.columns(gene), *more}, []
    for block in space.blocks:
        fits = [o for o in range(block.options) if wanted & {*block.all_columns} <= {*block.columns(o)}]
        if not fits:
            return None
        options.append(min(fits, key=lambda o: len(block.columns(o))))
    return space.gene(options)


def _duel(scorer: Scorer) -> None:
    """The best genes again with more effort, where they are close: a model that is caught in a worse metric
    must not decide."""
    limit = scorer.scores[scorer.best()] + SLACK * len(scorer.rows)
    ranked = sorted(scorer.scores, key=lambda g: scorer.scores[g])[:RIVALS]
    close = [g for g in ranked if scorer.scores[g] < limit and scorer.models[g]]
    for gene in close if len(close) > 1 else ():
        X = scorer.regressors(gene)
        model = fit_blended(X, np.ascontiguousarray(scorer.y), passes=4, factors=(1.0, 1.4))
        scorer.offer(gene, model)


def _level(model: Blended) -> int:
    return min(round(math.log2(model.M)), SCREENED)


def _check_blocks(scorer: Scorer) -> None:
    """Until no other value of a single block is better."""
    checked: set[int] = set()
    while (gene := scorer.best()) not in checked:
        checked.add(gene)
        model = scorer.models[gene]
        options = scorer.space.options(gene)
        others = [
            scorer.space.gene((*options[:b], option, *options[b + 1 :]))
            for b, block in enumerate(scorer.space.blocks)
            for option in range(block.options)
            if option != options[b]
        ]
        mine = set(scorer.space.columns(gene))
        for other in others:
            if mine.issuperset(scorer.space.columns(other)):
                scorer.refine(other, gene)
        scorer.race(others, _level(model) if model else 0, gene)


def _table(space: Space, rows: Array, points: Array, centres: list[Array], level: int) -> list[int]:
    """The best genes of the pooled criterion on one partition."""
    if level >= len(centres):
        return []
    unit = cdist(points, centres[level], "sqeuclidean").argmin(axis=1)
    return best_genes(space, of_regions(rows, unit, len(centres[level])), BEST)


def best_genes(space: Space, gram: Gram, count: int) -> list[int]:
    """The ``count`` genes of least pooled criterion, best first."""
    score = score_of("pooled", gram)
    if space.size <= WALKED:
        found = exhaustive(space, gram, score, count)
    else:
        found = coordinate(space, lambda g: score.of(gram, space.columns(g)), restarts=2)
    return [g for g, f in found.best[:count] if np.isfinite(f)]
