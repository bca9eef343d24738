from __future__ import annotations

import numpy as np
import pytest

from stages.criteria import score_of
from stages.gram import Gram, of_regions

SIZES = np.array([60, 140])


@pytest.fixture
def gram() -> Gram:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(200, 3))
    y = x[:, 0] + 0.1 * rng.normal(size=200)
    return of_regions(np.column_stack([x, y]), np.repeat([0, 1], SIZES), 2)


def test_the_formulas(gram: Gram) -> None:
    r, n, N = gram.rss([0, 2]), 2, SIZES.sum()
    k = n + 1
    pooled = N * np.log(r.sum() / N) + sum(m * np.log(m) * (k + 1) / (m - k - 2) for m in SIZES)
    printed = sum(4.0 * a / m + np.log(m) * (n + 1) / (m - n - 2) for a, m in zip(r, SIZES, strict=True))
    assert score_of("pooled", gram).of(gram, (0, 2)) == pytest.approx(pooled)
    assert score_of("printed", gram, scale=2.0).of(gram, (0, 2)) == pytest.approx(printed)
    assert score_of("bic", gram).of(gram, (0, 2)) == pytest.approx(
        N * np.log(r.sum() / N) + 2 * k * np.log(N)
    )
    assert score_of("aic", gram).of(gram, (0, 2)) == pytest.approx(N * np.log(r.sum() / N) + 4 * k)


def test_only_the_printed_one_depends_on_the_outputs_unit(gram: Gram) -> None:
    larger = Gram(gram.G.copy(), gram.counts)
    larger.G[-1] *= 10.0
    larger.G[:, -1] *= 10.0
    genes = [(), (0,), (0, 1), (0, 1, 2)]
    for criterion in ("pooled", "scaled", "bic", "aic"):
        one, two = (np.array([score_of(criterion, g).of(g, c) for c in genes]) for g in (gram, larger))
        np.testing.assert_allclose(np.diff(one), np.diff(two), rtol=1e-9)
    printed = [[score_of("printed", g).of(g, c) for c in genes] for g in (gram, larger)]
    assert not np.allclose(np.diff(printed[0]), np.diff(printed[1]))
    scaled = [score_of("printed", larger, scale=0.1).of(larger, c) for c in genes]
    assert scaled == pytest.approx(printed[0])


def test_a_region_with_too_few_rows_is_never_the_best() -> None:
    gram = of_regions(np.random.default_rng(0).normal(size=(5, 4)), np.zeros(5, dtype=int), 1)
    assert score_of("pooled", gram).of(gram, (0, 1, 2)) == np.inf
