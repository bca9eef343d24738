"""The likelihood of a window's samples against the multivariate normal that it stands for."""

from __future__ import annotations

from collections.abc import Callable
from math import log, pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from stages.hypotheses import ELAPSED, Hypothesis, Points
from stages.pair_search import IDLE, Pair, Search, Steps, Window, begun, refined
from stages.size_grid import refined_grid

N, SD = 30, 0.3
REGIME = np.arange(N) % 3
NOISE, MODEL = 0.5, 0.2
HYPOTHESES = [
    Hypothesis(
        undo={"residual.r": "`residual.r` - theta"}, sizes=(1.0, 2.0), inexact=0.1, blur="0.5 * `offset.r`"
    ),
    Hypothesis(undo={"residual.r": "`residual.r` - 2 * theta"}, sizes=(1.0, 2.0)),
]


@pytest.fixture
def window() -> Window:
    points = Points(HYPOTHESES, [], ["r"])
    e = np.random.default_rng(8).normal(1.0, 0.6, N)
    values = {
        "residual.r": e, "sigma.r": np.full(N, np.hypot(NOISE, MODEL)), "model_sd.r": np.full(N, MODEL),
        "novelty.r": np.zeros(N), "regime": REGIME, ELAPSED: np.arange(float(N)),
    }  # fmt: skip
    grid = refined_grid(HYPOTHESES, points.sizes, 0, 1)
    shapes = np.stack([np.ones((N, 1)), np.zeros((N, 1))], axis=2)
    return Window(points, grid, values, shapes, np.array([[SD, 0.0]]), np.ones((N, 1)), np.inf)


def expected(e: NDArray[np.float64], wrong: float, blur: float) -> float:
    """What all samples share and what those of a regime share, beside the noise."""
    same = REGIME[:, None] == REGIME
    cov = NOISE**2 * np.eye(N) + SD**2 + wrong**2 + (MODEL**2 + blur**2) * same
    return float(multivariate_normal(np.zeros(N), cov).logpdf(e)) + 0.5 * N * log(2 * pi)


def test_doubt_and_blur_are_shared_by_a_regime_and_what_may_be_wrong_by_all(window: Window) -> None:
    e = window.values["residual.r"]
    for k, (moved, wrong, blur) in enumerate(
        [(0, 0, 0), (1, 0.1, 0.15), (2, 0.2, 0.3), (2, 0, 0), (4, 0, 0)]
    ):
        height = window.likelihood(*window.split)[k]
        assert height == pytest.approx(expected(e - moved, wrong, blur), rel=1e-9)


def test_so_they_are_of_two_faults_at_once(window: Window) -> None:
    e = window.values["residual.r"]
    for x, y in ((1.0, 1.0), (1.5, 1.25)):
        height = window.both(np.array([[0, 1]]), np.array([[x, y]]))[0]
        assert height == pytest.approx(expected(e - x - 2 * y, 0.1 * (x + 2 * y), 0.15 * x), rel=1e-9)


def test_searches_together_find_what_each_finds_alone(window: Window) -> None:
    both = HYPOTHESES[0], HYPOTHESES[1]
    begins = {"near": ([1.0, 1.5], [1.2]), "far": ([2.0], [1.0, 2.0]), "few": ([1.2], [1.4])}

    def search(name: str) -> Search:
        return Search((0, 1), begun(both, *begins[name]))

    together = window.sought({name: search(name) for name in begins})
    assert list(together) == list(begins)
    for name in begins:
        assert window.sought({name: search(name)})[name] == together[name]


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
