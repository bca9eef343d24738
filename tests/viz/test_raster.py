from __future__ import annotations

import numpy as np
import polars as pl

from ingest.log import Group
from viz.raster import Raster, Reduction, curves, in_order


def test_missing_and_infinite_values_are_breaks() -> None:
    group = Group(
        "g", pl.DataFrame({"time": [2.0, 0.0, 1.0], "i": [1, None, 3], "f": [float("inf"), 2.0, None]})
    )
    time, values = curves(group, ["i", "f"])
    assert time.tolist() == [0.0, 1.0, 2.0]
    assert np.isfinite(values).tolist() == [[False, True], [True, False], [True, False]]


def test_time_stamps_that_are_not_finite_are_left_out() -> None:
    time, rows = in_order(Group("g", pl.DataFrame({"time": [1.0, float("inf"), 0.0], "v": [1.0, 2.0, 3.0]})))
    assert time.tolist() == [0.0, 1.0]
    assert rows.tolist() == [2, 0]


def test_signals_of_a_long_group_share_their_rows_and_keep_their_peaks_and_gaps() -> None:
    rng = np.random.default_rng(2)
    time = np.delete(np.arange(60_000) * 0.01, slice(20_000, 30_000))
    a, b = rng.normal(size=(2, time.size))
    a[7], b[33_333], b[40_000:45_000] = 50.0, -60.0, np.nan
    group = Group("g", pl.DataFrame({"time": time, "a": a, "b": b}))
    raster = Raster(group, ["a", "b"], Reduction(points=1000, windows=((80.0, 90.0),)))
    drawn = {name: raster.values(name) for name in ("a", "b")}
    for name, values in (("a", a), ("b", b)):
        assert drawn[name].shape == raster.time.shape
        assert (np.nanmax(drawn[name]), np.nanmin(drawn[name])) == (np.nanmax(values), np.nanmin(values))
        near = (raster.time > 80.0) & (raster.time < 90.0)
        assert drawn[name][near].tolist() == values[(time > 80.0) & (time < 90.0)].tolist()
    gap = (raster.time > 200.0) & (raster.time < 300.0)
    assert np.isnan(drawn["a"][gap]).any()
    lost = (raster.time > time[40_100]) & (raster.time < time[44_900])
    assert np.isnan(drawn["b"][lost]).all()
    assert np.isfinite(drawn["a"][lost]).all()
    assert 1900 < raster.time.size < 2100
