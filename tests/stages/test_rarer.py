"""Rarer faults on the made-up engine: an offset is told from a gain where the operating point moves."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from made_up_engine import STAGES, drive, fitted_to

from ingest.log import Group, Log
from stages.hypotheses import Hypothesis
from stages.pairs import Pairs
from stages.stage import ANALYSIS, Stage, transform

OFFSETS = {
    "sensor_offset": {
        "W": Hypothesis(undo={"W": "W - theta"}, sizes=(-9, -6, -4, -2, 2, 4, 6, 9), unit="g/s", signal="W"),
        "p": Hypothesis(
            undo={"p": "p - theta"}, sizes=(-0.2, -0.1, -0.05, 0.05, 0.1, 0.2), unit="kPa", signal="p"
        ),
    }
}


@pytest.fixture(scope="module")
def fitted() -> list[Stage]:
    return fitted_to((*STAGES, Pairs(also=OFFSETS)))


def shifted(log: Log, column: str, by: float, at: float = 200.0) -> Log:
    group = log.groups[ANALYSIS]
    frame = group.frame.with_columns(pl.col(column) + by * (pl.col("time") >= at).cast(pl.Float64))
    return Log(log.name, {ANALYSIS: Group(ANALYSIS, frame)})


@pytest.mark.parametrize(("column", "by"), [("W", 6.0), ("W", -5.0), ("p", 0.1), ("p", -0.08)])
def test_an_offset_is_named_measured_and_its_sensor_told(fitted: list[Stage], column: str, by: float) -> None:
    last = transform(fitted, shifted(drive(7), column, by)).groups[ANALYSIS].frame.row(-1, named=True)
    assert last["p.sensor_offset"] > 0.9
    evident = {s: last[f"sensor.sensor_offset.{s}"] for s in ("W", "p")}
    assert max(evident, key=lambda s: evident[s]) == column
    found, sd = (last[f"{kind}.sensor_offset.{column}"] for kind in ("size", "size_sd"))
    assert found == pytest.approx(by, rel=0.15)
    assert abs(found - by) < 5 * sd


@pytest.mark.parametrize("fault", [{"flow": 0.05}, {"pressure": -0.03}, {"leak": 2.0}])
def test_another_fault_is_no_offset(fitted: list[Stage], fault: dict[str, float]) -> None:
    frame = transform(fitted, drive(8, **fault)).groups[ANALYSIS].frame
    assert frame.filter(pl.col("time") > 400)["p.sensor_offset"].max() < 0.05  # type: ignore[operator]
    named = [c.removeprefix("evidence.") for c in frame.columns if c.startswith("evidence.")]
    on = frame.filter(pl.col("detection") == 1)
    np.testing.assert_allclose(
        on.select(pl.sum_horizontal(f"p.{f}" for f in named)).to_series(), 1.0, atol=1e-5
    )


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_gain_that_grows_is_no_offset(fitted: list[Stage], sign: int) -> None:
    """Over the episode no fault of one size fits, so that any says more than `unknown` in the window."""
    frame = drive(9).groups[ANALYSIS].frame
    size = sign * np.clip((frame["time"].to_numpy() - 200) / 200, 0, 1) * 0.08
    log = Log("grows", {ANALYSIS: Group(ANALYSIS, frame.with_columns(p=pl.col("p") * (1 + size)))})
    out = transform(fitted, log).groups[ANALYSIS].frame.filter(pl.col("time") > 460)
    assert out["p.pressure_gain"].min() > 0.5  # type: ignore[operator]


def test_without_an_alarm_nothing_is_said(fitted: list[Stage]) -> None:
    frame = transform(fitted, drive(9)).groups[ANALYSIS].frame
    assert frame["p.sensor_offset"].max() == 0.0
    assert frame["size.sensor_offset.W"].is_nan().all()


def test_blocks_do_not_matter(fitted: list[Stage]) -> None:
    log = shifted(drive(8), "W", 6.0)
    whole, parts = (transform(fitted, log, block).groups[ANALYSIS].frame for block in (None, 7.3))
    for column in (c for c in whole.columns if "sensor_offset" in c):
        np.testing.assert_allclose(whole[column], parts[column], rtol=1e-4, atol=1e-6)
