"""The walk over all genes, and the Gram matrices it is fed with, against least squares on the rows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.criteria import CRITERIA, score_of
from stages.exhaustive import exhaustive, weighted_rss
from stages.genes import Space
from stages.gram import gather, of_regions
from stages.lags import Lagged

Array = NDArray[np.float64]
SPACE = Space.of(["y", "v"], ["u"], na_max=2, nb_max=2, nk_max=3)
M = 5


def made(seed: int = 0, lengths: tuple[int, ...] = (4000, 9000)) -> Lagged:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(size=(n, 3)) + np.array([5.0, -3.0, 100.0]) for n in lengths]
    place = {"y": 0, "v": 1, "u": 2}
    return Lagged(
        parts,
        np.array([place[n] for n, _ in SPACE.candidates]),
        np.array([k for _, k in SPACE.candidates]),
        0,
    )


@pytest.fixture(scope="module")
def rows() -> Array:
    return made().sample(10**6)


@pytest.fixture(scope="module")
def nodes(rows: Array) -> Array:
    return np.random.default_rng(1).normal(size=(M, rows.shape[1] - 1))


def least_squares(X: Array, y: Array) -> float:
    A = np.column_stack([np.ones(len(X)), X])
    return float(((y - A @ np.linalg.lstsq(A, y, rcond=None)[0]) ** 2).sum())


def test_the_streaming_pass_and_the_walk_agree_with_least_squares_on_the_rows(
    rows: Array, nodes: Array
) -> None:
    centre, scale = rows.mean(axis=0), rows.std(axis=0)
    gram = gather(made(), centre, scale, nodes)
    S = (rows - centre) / scale
    unit = ((S[:, None, :-1] - nodes) ** 2).sum(axis=2).argmin(axis=1)
    np.testing.assert_array_equal(gram.counts, np.bincount(unit, minlength=M))
    np.testing.assert_allclose(of_regions(S, unit, M).G, gram.G, rtol=1e-9, atol=1e-7)
    r = weighted_rss(SPACE, gram, np.ones(M))
    for gene in np.random.default_rng(2).integers(SPACE.size, size=12):
        columns = list(SPACE.columns(int(gene)))
        each = [least_squares(S[unit == m][:, columns], S[unit == m, -1]) for m in range(M)]
        np.testing.assert_allclose(gram.rss(columns), each, rtol=1e-8)
        np.testing.assert_allclose(r[gene], sum(each), rtol=1e-8)


@pytest.mark.parametrize("fixed", [(), ("u",), ("y", "v")])
def test_every_gene_has_its_own_value(rows: Array, fixed: tuple[str, ...]) -> None:
    space = Space.of(["y", "v"], ["u"], na_max=2, nb_max=2, nk_max=3, fixed=fixed)
    gram = of_regions(rows[:300], np.arange(300) % 3, 3)
    weight = np.array([1.0, 2.0, 0.5])
    expected = [weight @ gram.rss(space.columns(g)) for g in range(space.size)]
    np.testing.assert_allclose(weighted_rss(space, gram, weight), expected, rtol=1e-10)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_the_optimum_is_the_least_of_all(rows: Array, criterion: str) -> None:
    gram = of_regions(rows[:600], np.arange(600) % 2, 2)
    score = score_of(criterion, gram, 3.0)  # type: ignore[arg-type]
    every = [score.of(gram, SPACE.columns(g)) for g in range(SPACE.size)]
    found = exhaustive(SPACE, gram, score)
    assert found.optimal
    assert found.evaluated == SPACE.size
    assert found.gene == int(np.argmin(every))
    assert [s for _, s in found.best] == pytest.approx(sorted(every)[: len(found.best)])


def test_dependent_and_constant_candidates_add_nothing() -> None:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(400, 3))
    rows = np.column_stack([x[:, 0], x[:, 1], 2 * x[:, 0] - x[:, 1], np.zeros(400), x.sum(axis=1)])
    gram = of_regions(rows, np.zeros(400, dtype=int), 1)
    assert gram.rss([0, 1, 2, 3])[0] == pytest.approx(gram.rss([0, 1])[0], rel=1e-6)


def test_a_space_that_is_too_large_is_refused() -> None:
    space = Space.of(["y"], [f"u{i}" for i in range(7)], na_max=3, nb_max=3, nk_max=7)
    with pytest.raises(RecipeError, match="--search coordinate"):
        weighted_rss(space, of_regions(np.ones((2, 2)), np.zeros(2, dtype=int), 1), np.ones(1))
