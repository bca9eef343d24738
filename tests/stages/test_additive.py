"""Two faults by what each does alone: exact where residuals are straight lines in the sizes."""

from __future__ import annotations

import numpy as np
import pytest

from stages.additive import Additive
from stages.hypotheses import Hypothesis
from stages.likelihood import log_likelihoods
from stages.pooled import as_computed, pooled
from stages.size_grid import refined_grid

SIZES = (-0.1, -0.05, 0.05, 0.1)
FAULTS = [Hypothesis(undo={c: "theta"}, sizes=SIZES) for c in "ab"]
GRID = refined_grid(FAULTS, [SIZES, SIZES], 0, 3)
N, R = 60, 2
SD = np.array([[0.01, 0.0], [0.02, 0.03]])


def drive(a: float, b: float, doubt: float = 0.0) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Residuals with two faults, undone by ``a`` and ``b``: e, sigma and doubt at the computed points."""
    rng = np.random.default_rng(1)
    slopes = rng.normal(size=(N, R, 2))
    e_0 = slopes @ np.array([a, b]) + rng.normal(scale=0.01, size=(N, R))
    at = np.array([[0.0, 0.0], *([x, 0.0] for x in SIZES), *([0.0, x] for x in SIZES)])
    e = e_0[:, :, None] - slopes @ at.T
    like = np.ones_like(e)
    return (e, 0.01 * like, doubt * np.abs(e - e[:, :, :1])), np.ones((N, R, 2)), np.full((N, R), 0.3)


def test_sizes_of_two_faults_lie_at_the_vertex() -> None:
    row, shapes, weight = drive(0.04, -0.07)
    e, sigma, doubt = row
    found = Additive.of(GRID, SD, (e, sigma, doubt), shapes, weight, near=1, clip=np.inf)
    gain, sizes = found.pair(0, 1, (0.0, 0.0))
    assert gain > 100
    assert sizes == pytest.approx((0.04, -0.07), abs=2e-3)


def test_one_fault_alone_is_as_likely_as_its_own_sums_say() -> None:
    row, shapes, weight = drive(0.04, 0.0)
    e, sigma, doubt = row
    found = Additive.of(GRID, SD, (e, sigma, doubt), shapes, weight, near=3, clip=np.inf)
    L = log_likelihoods(
        pooled(
            (e, sigma, 0 * e, 0 * e, doubt), as_computed(9), shapes, weight, np.inf, np.array([0, len(e)])
        ),
        SD,
        SD,
    )
    for f in (0, 1):
        _, points = found.fault(f)
        computed = GRID.share[points] == 0
        alone = found.likelihood(points, np.zeros(1, dtype=np.int64))[computed, 0]
        np.testing.assert_allclose(alone, L[GRID.left[points[computed]]], rtol=1e-9)
    assert found.pair(0, 1, (0.0, 0.0))[0] < 5  # a second one explains next to nothing


def test_doubts_that_shrink_leave_a_number() -> None:
    row, shapes, weight = drive(0.04, -0.07)
    e, sigma, _ = row
    doubt = 0.05 * np.ones_like(e)
    doubt[:, :, 1:] = 0.0
    gain, _ = Additive.of(GRID, SD, (e, sigma, doubt), shapes, weight, near=1, clip=4.0).pair(
        0, 1, (0.0, 0.0)
    )
    assert np.isfinite(gain)


def test_a_fault_is_no_smaller_than_it_may_be() -> None:
    row, shapes, weight = drive(0.04, 0.01)
    e, sigma, doubt = row
    found = Additive.of(GRID, SD, (e, sigma, doubt), shapes, weight, near=3, clip=np.inf)
    assert found.pair(0, 1, (0.02, 0.0))[1] == pytest.approx((0.04, 0.01), abs=2e-3)
    gain, sizes = found.pair(0, 1, (0.02, 0.05))
    assert abs(sizes[1]) >= 0.05
    assert gain < found.pair(0, 1, (0.02, 0.0))[0]
