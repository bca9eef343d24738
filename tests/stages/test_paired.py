from __future__ import annotations

import numpy as np
import pytest

from stages.paired import compare


def interval(a: np.ndarray, b: np.ndarray, **how: object):  # type: ignore[no-untyped-def]
    settings = {"more_is_better": True, **how}
    a, b = np.atleast_2d(a), np.atleast_2d(b)
    return compare(a, b, np.ones(a.shape[1]), np.random.default_rng(0), **settings)  # type: ignore[arg-type]


def test_equal_values_are_not_worse() -> None:
    x = np.random.default_rng(1).normal(size=20)
    found = interval(x, x)
    assert (found.difference, found.verdict, found.drives) == (0.0, "not worse", 20)


@pytest.mark.parametrize(("sign", "verdict"), [(1, "better"), (-1, "worse")])
def test_a_clear_difference_by_its_sign(sign: int, verdict: str) -> None:
    rng = np.random.default_rng(2)
    a = rng.normal(size=30)
    b = a + sign * (1.0 + 0.1 * rng.normal(size=30))
    assert interval(a, b).verdict == verdict
    assert interval(b, a, more_is_better=False).verdict == verdict


@pytest.mark.parametrize("n", [4, 8, 30])
def test_the_interval_holds_the_truth_as_often_as_it_says(n: int) -> None:
    rng = np.random.default_rng(3)
    held = []
    for _ in range(400):
        d = rng.normal(0.5, 1.0, size=n)
        found = interval(np.zeros(n), d)
        held.append(found.low <= 0.5 <= found.high)
    assert np.mean(held) > 0.92


def test_without_discordance_a_share_says_no_more_than_three_over_n() -> None:
    found = interval(np.ones(30), np.ones(30), share=True)
    assert (found.low, found.high, found.verdict) == (-0.1, 0.1, "undecided")
    assert interval(np.ones(300), np.ones(300), share=True).verdict == "not worse"


def test_a_rate_without_events_says_no_more_than_three_over_the_hours() -> None:
    none = np.zeros((1, 10))
    found = compare(none, none, np.full(10, 0.5), np.random.default_rng(0), more_is_better=False, rate=True)
    assert found is not None
    assert found.low == pytest.approx(-0.6)


def test_a_single_drive_proves_nothing() -> None:
    found = interval(np.array([0.0]), np.array([9.0]))
    assert found.verdict == "undecided"
    assert found.to_json()["low"] is None


def test_drives_without_a_value_do_not_count() -> None:
    a, b = np.array([1.0, np.nan, 2.0, 3.0]), np.array([1.0, 1.0, np.nan, 3.0])
    assert interval(a, b).drives == 2
    assert interval(np.array([np.nan]), np.array([1.0])) is None


def test_a_difference_within_the_zone_is_neither_better_nor_worse() -> None:
    a = np.random.default_rng(4).normal(size=40)
    assert interval(a, a + 0.01).verdict == "better"
    assert interval(a, a + 0.01, same=0.02).verdict == "not worse"
    assert interval(a, a - 0.01, same=0.02).verdict == "not worse"


def test_uncertain_thresholds_widen_the_interval() -> None:
    """What differs by the draw of the calibration logs, alike on all drives, does not average out."""
    rng = np.random.default_rng(5)
    a = rng.normal(size=(1, 50))
    b = a + np.concatenate([[0.0], rng.normal(size=200)])[:, None]
    fixed, drawn = interval(a, a + 0.0), interval(np.broadcast_to(a, b.shape), b)
    assert fixed.high - fixed.low < 0.01
    assert drawn.high - drawn.low > 2.0
