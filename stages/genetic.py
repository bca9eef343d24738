"""Genetic search (Goldberg 1989) over the binary genes of (4.13), with the parameters of Table 4.1.

A generation is ranked by the criterion; the best ``elite`` genes live on, and the others are children of
parents that won a tournament each. Two parents cross with probability ``crossover_rate``; in each child,
with probability ``mutation_rate``, the bits of one variable's part are drawn anew. An illegal child or one
that the generation already has is replaced by a gene drawn at random, so that the population never
collapses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.genes import Space
from stages.search import Found, Memo

Bits = NDArray[np.bool_]
Crossover = Literal["one", "two", "multi"]


@dataclass(frozen=True, kw_only=True)
class Genetic:
    """``population`` N_pop, ``elite`` N_elite, ``generations`` (N_gen)_max, ``crossover`` M_c at one, two or
    many points, ``crossover_rate`` R_c, ``mutation_rate`` R_m; it ends after ``patience`` generations without
    gain.

    Raises:
        RecipeError: a value out of range.
    """

    population: int = 50
    elite: int = 2
    generations: int = 500
    crossover: Crossover = "two"
    crossover_rate: float = 0.8
    mutation_rate: float = 0.2
    tournament: int = 2
    patience: int = 100

    def __post_init__(self) -> None:
        if not 0 <= self.elite < self.population or self.generations < 1 or self.tournament < 1:
            raise RecipeError(
                f"genetic: needs 0 <= elite < population, generations >= 1, tournament >= 1; got elite = "
                f"{self.elite}, population = {self.population}, generations = {self.generations}, "
                f"tournament = {self.tournament}"
            )
        if not (0 <= self.crossover_rate <= 1 and 0 <= self.mutation_rate <= 1):
            raise RecipeError(
                f"genetic: crossover_rate = {self.crossover_rate} and mutation_rate = {self.mutation_rate} "
                "must be between 0 and 1"
            )


def genetic(
    space: Space,
    criterion: Callable[[int], float],
    settings: Genetic | None = None,
    *,
    seed: int = 0,
    until: Callable[[int], bool] = lambda gene: False,
) -> Found:
    """The least ``criterion`` of a gene met; ``until`` ends it when it holds for the best gene.

    >>> space = Space.of(["y"], ["u"], na_max=3, nb_max=3, nk_max=7)
    >>> genetic(space, lambda gene: float((gene - 42) ** 2)).gene
    42
    """
    settings, rng, memo = settings or Genetic(), np.random.default_rng(seed), Memo(criterion)
    number = min(settings.population, space.size)
    genes = list(dict.fromkeys(int(g) for g in rng.integers(space.size, size=number)))
    history: list[float] = []
    for _ in range(settings.generations):
        genes.sort(key=memo)
        history.append(memo(genes[0]))
        waiting = len(history) > settings.patience and history[-1] == history[-1 - settings.patience]
        if until(genes[0]) or waiting:
            break
        genes = _next(genes, number, space, settings, rng)
    return Found.from_scores(memo.scores, history, size=space.size)


def _next(
    ranked: list[int], number: int, space: Space, settings: Genetic, rng: np.random.Generator
) -> list[int]:
    """The following generation of ``number`` different genes."""
    following = dict.fromkeys(ranked[: settings.elite])
    while len(following) < number:
        mother, father = (
            ranked[int(rng.integers(len(ranked), size=settings.tournament).min())] for _ in "ab"
        )
        children = space.encode(mother), space.encode(father)
        if rng.random() < settings.crossover_rate:
            children = _cross(*children, settings.crossover, rng)
        for bits in children:
            if rng.random() < settings.mutation_rate:
                bits = _mutated(bits, space, rng)
            child = space.decode(bits)
            if child is None or child in following:
                child = int(rng.integers(space.size))
            if len(following) < number:
                following[child] = None
    return list(following)


def _cross(a: Bits, b: Bits, kind: Crossover, rng: np.random.Generator) -> tuple[Bits, Bits]:
    """Both children of a crossover at one point, two points, or each bit by chance."""
    n = len(a)
    if kind == "multi":
        swapped = rng.random(n) < 0.5
    else:
        points = np.sort(rng.integers(1, max(n, 2), size={"one": 1, "two": 2}[kind]))
        swapped = np.searchsorted(points, np.arange(n), side="right") % 2 == 1
    return np.where(swapped, b, a), np.where(swapped, a, b)


def _mutated(bits: Bits, space: Space, rng: np.random.Generator) -> Bits:
    """The bits of one variable's part drawn anew."""
    gene = space.decode(bits)
    if gene is None:
        return bits
    options, b = list(space.options(gene)), int(rng.integers(len(space.blocks)))
    options[b] = int(rng.integers(space.blocks[b].options))
    return space.encode(space.gene(options))
