"""The likelihood of a window's samples against the multivariate normal that it stands for."""

from __future__ import annotations

from math import log, pi

import numpy as np
import pytest
from made_up_window import MODEL, NOISE, REGIME, SD, N, made_up_window
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from stages.alarm_window import Window


@pytest.fixture
def window() -> Window:
    return made_up_window()


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


def test_points_of_several_pairs_are_judged_each_by_its_own(window: Window) -> None:
    """The first hypothesis has a blur and may be inexact, the second neither."""
    e = window.values["residual.r"]
    which = np.array([[0, 1], [1, 1], [1, 0]])
    sizes = np.array([[1.5, 1.25], [1.0, 1.5], [1.0, 2.0]])
    found = window.both(which, sizes)
    assert found[0] == pytest.approx(expected(e - 4.0, 0.1 * 4.0, 0.15 * 1.5), rel=1e-9)
    assert found[1] == pytest.approx(expected(e - 5.0, 0.0, 0.0), rel=1e-9)
    assert found[2] == pytest.approx(expected(e - 4.0, 0.1 * 4.0, 0.15 * 2.0), rel=1e-9)
