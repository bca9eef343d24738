"""The searches that do not see everything, against the table of everything."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.coordinate import coordinate
from stages.genes import Space
from stages.genetic import Crossover, Genetic, genetic
from stages.search import Memo

SPACE = Space.of(["y"], ["u", "v"], na_max=3, nb_max=3, nk_max=7)


@pytest.fixture(scope="module")
def table() -> NDArray[np.float64]:
    """A bowl in the options of each block, with ruggedness."""
    target = np.array(SPACE.options(SPACE.size * 5 // 7))
    away = [np.abs(np.array(SPACE.options(g)) - target).sum() for g in range(SPACE.size)]
    return np.array(away) + np.random.default_rng(0).uniform(0, 2, SPACE.size)


@pytest.fixture
def criterion(table: NDArray[np.float64]) -> Callable[[int], float]:
    return lambda gene: float(table[gene])


@pytest.mark.parametrize("crossover", ["one", "two", "multi"])
def test_the_genetic_search_finds_the_optimum(
    criterion: Callable[[int], float], table: NDArray[np.float64], crossover: Crossover
) -> None:  # fmt: skip
    settings = Genetic(crossover=crossover, generations=150, patience=150)
    for seed in range(3):
        found = genetic(SPACE, criterion, settings, seed=seed)
        assert found.gene == int(table.argmin())
        assert not found.optimal
        assert (np.diff(found.history) <= 0).all()  # the elite lives on
        assert found.evaluated < SPACE.size


def test_the_coordinate_search_finds_the_optimum_with_few_evaluations(
    criterion: Callable[[int], float], table: NDArray[np.float64]
) -> None:  # fmt: skip
    for seed in range(5):
        found = coordinate(SPACE, criterion, restarts=10, seed=seed)
        assert found.gene == int(table.argmin())
        assert found.evaluated < SPACE.size / 2
        assert found.score == table.min()


def test_a_seed_repeats_a_search(criterion: Callable[[int], float]) -> None:
    settings = Genetic(generations=5)
    one, again, other = (genetic(SPACE, criterion, settings, seed=s) for s in (1, 1, 2))
    assert one.best == again.best
    assert one.best != other.best
    assert coordinate(SPACE, criterion, seed=1).best == coordinate(SPACE, criterion, seed=1).best


def test_the_genetic_search_stops_when_told(criterion: Callable[[int], float]) -> None:
    assert len(genetic(SPACE, criterion, Genetic(patience=3)).history) < 100
    assert len(genetic(SPACE, criterion, Genetic(), until=lambda gene: True).history) == 1


def test_a_space_smaller_than_the_population_is_seen_whole() -> None:
    space = Space.of([], ["a", "b"], na_max=0, nb_max=1, nk_max=0)
    found = genetic(space, lambda g: float(g), Genetic(generations=50))
    assert (found.gene, found.evaluated, found.optimal) == (0, 4, True)


def test_nothing_is_computed_twice() -> None:
    asked: list[int] = []

    def criterion(gene: int) -> float:
        asked.append(gene)
        return float(gene)

    memo = Memo(criterion)
    assert [memo(g) for g in (3, 1, 3, 3)] == [3, 1, 3, 3]
    assert asked == [3, 1]


@pytest.mark.parametrize("wrong", [{"elite": 50}, {"crossover_rate": 1.1}, {"mutation_rate": -0.1}])
def test_wrong_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(RecipeError):
        Genetic(**wrong)  # type: ignore[arg-type]
