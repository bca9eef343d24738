"""Coordinate search: one variable's part of the gene at a time, for spaces too large to be walked.

From a random gene, every other value of one block (an output's ``n_a``, an input's ``(n_b, n_k)``) is
evaluated and the best kept; the blocks follow each other in random order until none improves. Then it starts
again from another gene, ``restarts`` times. Scores are remembered.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.genes import Space
from stages.search import Found, Memo


def coordinate(space: Space, criterion: Callable[[int], float], *, restarts: int = 3, seed: int = 0) -> Found:
    """The least ``criterion`` of a gene met from ``restarts`` + 1 random genes.

    >>> space = Space.of(["y"], ["u"], na_max=3, nb_max=3, nk_max=7)
    >>> coordinate(space, lambda gene: float((gene - 42) ** 2)).gene
    42
    """
    rng, memo, history = np.random.default_rng(seed), Memo(criterion), []
    best: int | None = None
    for _ in range(restarts + 1):
        gene = _descend(space, memo, rng)
        if best is None or memo(gene) < memo(best):
            best = gene
        history.append(memo(best))
    assert best is not None
    return Found.from_scores(memo.scores, history, size=space.size)


def _descend(space: Space, memo: Memo, rng: np.random.Generator) -> int:
    blocks = space.blocks
    gene = space.gene([int(rng.integers(b.options)) for b in blocks])
    still = 0  # blocks in a row that did not improve
    while still < len(blocks):
        for b in rng.permutation(len(blocks)):
            options = list(space.options(gene))
            values = []
            for option in range(blocks[b].options):
                options[b] = option
                values.append(space.gene(options))
            other = min(values, key=memo)
            still = 0 if memo(other) < memo(gene) else still + 1
            gene = other if still == 0 else gene
            if still == len(blocks):
                break
    return gene
