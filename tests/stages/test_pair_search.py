from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np
import pytest
from made_up_window import HYPOTHESES, made_up_window
from numpy.typing import NDArray

from stages.pair_search import IDLE, Pair, Search, Steps, begun, refined, sought


def test_searches_together_find_what_each_finds_alone() -> None:
    window = made_up_window()
    both = HYPOTHESES[0], HYPOTHESES[1]
    begins = {"near": ([1.0, 1.5], [1.2]), "far": ([2.0], [1.0, 2.0]), "few": ([1.2], [1.4])}

    def search(name: str) -> Search:
        return Search((0, 1), begun(both, *begins[name]))

    together = sought(window, {name: search(name) for name in begins})
    assert list(together) == list(begins)
    for name in begins:
        assert sought(window, {name: search(name)})[name] == together[name]


def followed(steps: Steps, L: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> tuple[Pair, int]:
    """What a search comes to, and how often it asked."""
    sizes, asked = next(steps), 1
    try:
        while True:
            sizes, asked = steps.send(L(sizes)), asked + 1
    except StopIteration as end:
        return end.value, asked


def test_the_vertex_of_a_parabola_is_found_with_its_spread() -> None:
    precision, vertex = np.array([[400.0, 150.0], [150.0, 250.0]]), np.array([1.33, 1.71])

    def L(x: NDArray[np.float64]) -> NDArray[np.float64]:
        d = x - vertex
        return np.asarray(7.0 - 0.5 * ((d @ precision) * d).sum(axis=1))

    found, asked = followed(begun((HYPOTHESES[0], HYPOTHESES[1]), [1.0, 2.0], [1.0, 2.0]), L)
    C = np.linalg.inv(precision)
    assert found.sizes == pytest.approx(vertex, abs=0.1 * np.sqrt(np.diag(C)).min())
    assert found.sds == pytest.approx(np.sqrt(np.diag(C)), rel=1e-3)
    assert found.height - found.share == pytest.approx(7.0, abs=0.05)
    assert np.exp(found.share) == pytest.approx(2 * pi * np.sqrt(np.linalg.det(C)), rel=1e-3)
    assert asked <= 8


def test_a_search_ends_where_nothing_is_gained() -> None:
    def ridge(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(-((x[:, 0] + x[:, 1] - 3.0) ** 2))

    _, asked = followed(refined((HYPOTHESES[0], HYPOTHESES[1]), np.array([1.5, 1.5]), 12), ridge)
    assert asked == 1 + IDLE
