"""Search: what the ways of searching a space of genes have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(eq=False)
class Memo:
    """A criterion of genes that remembers what it was asked; no value is computed twice."""

    criterion: Callable[[int], float]
    scores: dict[int, float] = field(default_factory=dict)

    def __call__(self, gene: int) -> float:
        if gene not in self.scores:
            self.scores[gene] = self.criterion(gene)
        return self.scores[gene]


@dataclass(frozen=True, eq=False)
class Found:
    """The best gene; the best ones met with their scores, best first; how many were evaluated; the best score
    after each generation, start or round; whether the optimum is proven."""

    gene: int
    best: tuple[tuple[int, float], ...]
    evaluated: int
    history: tuple[float, ...]
    optimal: bool

    @property
    def score(self) -> float:
        return self.best[0][1]

    @classmethod
    def from_scores(
        cls, scores: dict[int, float], history: list[float], *, size: int, shown: int = 50
    ) -> Found:
        """What a search that evaluated ``scores`` by gene has found in a space of ``size`` genes."""
        best = sorted(scores.items(), key=lambda item: (item[1], item[0]))[:shown]
        return cls(best[0][0], tuple(best), len(scores), tuple(history), optimal=len(scores) == size)
