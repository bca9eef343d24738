from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from stages.tree import nested_centres


def test_a_line_is_cut_evenly() -> None:
    levels = nested_centres(np.linspace(0, 1, 2000)[:, None], 4)
    assert [len(c) for c in levels] == [1, 2, 4, 8, 16]
    np.testing.assert_allclose(np.sort(levels[2].ravel()), [0.125, 0.375, 0.625, 0.875], atol=0.01)


def test_each_level_describes_the_points_better_and_again_the_same() -> None:
    X = np.random.default_rng(0).normal(size=(3000, 4)) * np.array([3.0, 1.0, 1.0, 0.1])
    levels = nested_centres(X, 5)
    error = [(cdist(X, c).min(axis=1) ** 2).mean() for c in levels]
    assert (np.diff(error) < 0).all()
    for a, b in zip(levels, nested_centres(X, 5), strict=True):
        np.testing.assert_array_equal(a, b)
    first = levels[1][1] - levels[1][0]
    assert abs(first[0]) > 20 * abs(first[3])  # across the widest axis


def test_cells_too_small_or_without_extent_are_left_whole() -> None:
    assert [len(c) for c in nested_centres(np.ones((50, 2)), 3)] == [1]
    assert len(nested_centres(np.random.default_rng(1).normal(size=(7, 2)), 5)[-1]) < 3
