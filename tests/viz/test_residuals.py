from __future__ import annotations

import numpy as np
import polars as pl

from viz.residuals import names, telling_rows, view_range


def test_residuals_and_indicators_are_found_in_order() -> None:
    frame = pl.DataFrame({"time": [], "residual.b.c": [], "sigma.b.c": [], "indicator.a": []})
    assert names(frame) == [("b.c", "residual.b.c"), ("a", "indicator.a")]


def test_the_range_holds_all_values_of_an_ordinary_residual() -> None:
    value = np.random.default_rng(0).normal(size=5000)
    low, high = view_range(value, np.zeros(5000), np.ones(5000))
    assert low < value.min()
    assert high > value.max()
    assert high == -low
    assert high < 6.0


def test_one_wild_value_does_not_flatten_the_rest() -> None:
    value = np.random.default_rng(0).normal(size=5000)
    value[7] = 1e6
    assert view_range(value, np.zeros(5000), np.ones(5000))[1] < 20.0


def test_a_quiet_residual_is_shown_with_its_band() -> None:
    low, high = view_range(np.full(10, 1e-3), np.zeros(10), np.ones(10))
    assert low < -3.0
    assert high > 3.0


def test_an_indicator_is_shown_about_its_healthy_value() -> None:
    low, high = view_range(np.full(10, 5.2), np.full(10, 5.0), np.full(10, 0.1))
    assert 4.0 < low < 4.7
    assert 5.3 < high < 6.0


def test_nothing_known_has_a_range_too() -> None:
    nothing = np.full(3, np.nan)
    assert view_range(nothing, nothing, nothing) == (-1.0, 1.0)
    assert view_range(np.zeros(3), np.zeros(3), np.zeros(3)) == (-1.0, 1.0)


def test_rows_in_alarm_tell_more_than_the_others() -> None:
    assert telling_rows(pl.DataFrame({"detection": [0, 1, 0]})).tolist() == [False, True, False]
    assert telling_rows(pl.DataFrame({"detection": [0, 0]})).tolist() == [True, True]
