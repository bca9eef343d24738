from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError
from ingest.log import Group, Log
from pipeline import diagnose
from pipeline.detector import Detector
from pipeline.diagnosing import corrected
from stages.results import Diagnosis, Verdict


@pytest.fixture(scope="module")
def whole(detector: Detector, faulty: Log) -> Diagnosis:
    return diagnose(faulty, detector, quality={"W_HFM": {"gaps": 0}})


def assert_close(one: pl.DataFrame, two: pl.DataFrame) -> None:
    """Equal but for the last digits, which the linear algebra's own blocking may change."""
    assert one.schema == two.schema
    assert one.height == two.height
    for column, dtype in one.schema.items():
        x, y = (f[column].cast(pl.Float64).fill_null(np.nan).to_numpy() for f in (one, two))
        rtol = 1e-4 if dtype == pl.Float32 else 1e-7
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-6, err_msg=column)


@pytest.mark.parametrize("block_s", [9.7, 60.0, 1e4])
def test_does_not_depend_on_the_block_size(
    whole: Diagnosis, detector: Detector, faulty: Log, block_s: float
) -> None:
    parts = diagnose(faulty, detector, block_s=block_s)
    assert_close(parts.samples, whole.samples)
    assert parts.verdict.fault == whole.verdict.fault
    assert parts.verdict.detected_s == whole.verdict.detected_s


def test_nothing_before_the_end_depends_on_what_comes_later(
    whole: Diagnosis, detector: Detector, faulty: Log
) -> None:
    early = diagnose(faulty.between(0.0, 200.0), detector).samples
    known = early.filter(pl.col("time") < 195.0)
    assert known.height > 300
    assert_close(known, whole.samples.head(known.height))


def test_verdict_carries_what_was_given(whole: Diagnosis, detector: Detector) -> None:
    verdict = whole.verdict
    assert (verdict.log, verdict.recipe, verdict.detector) == ("faulty", "diesel_airpath", detector.key)
    assert verdict.quality == {"W_HFM": {"gaps": 0}}
    assert verdict.signal == "W_HFM"
    assert verdict.statistics["truth"] == ["maf_gain"]


def test_every_residual_has_a_unit(whole: Diagnosis) -> None:
    names = {c.removeprefix("residual.") for c in whole.samples.columns if c.startswith("residual.")}
    assert set(whole.units) == names
    assert all(whole.units.values())


def test_operating_map_has_a_point_per_row(whole: Diagnosis) -> None:
    plane = whole.operating_map
    assert plane is not None
    assert (plane.x_label, plane.y_label) == ("n_Eng [rpm]", "p_Int [kPa]")
    assert plane.x.shape == plane.y.shape == (whole.samples.height,)
    assert len(plane.nodes) == len(plane.visits) == len(plane.spread)
    assert plane.edges.max() < len(plane.nodes)
    assert np.nanmin(plane.x) <= plane.nodes[:, 0].min() <= plane.nodes[:, 0].max() <= np.nanmax(plane.x)


def test_too_little_data_is_insufficient_evidence(detector: Detector, healthy: list[Log]) -> None:
    assert diagnose(healthy[1].between(0.0, 30.0), detector).verdict.fault == "insufficient_evidence"


def test_missing_signal(detector: Detector, faulty: Log) -> None:
    log = replace(faulty, groups={"g": Group("g", pl.DataFrame({"time": [0.0], "p_Boost": [1.0]}))})
    with pytest.raises(LogError, match="'faulty' has no signal 'p_"):
        diagnose(log, detector)


def test_both_of_two_isolated_sensors_are_corrected(detector: Detector, healthy: list[Log]) -> None:
    log, pair = healthy[0], "boost_pressure_gain+maf_gain"
    samples = pl.DataFrame(
        {
            "time": [0.0],
            "detection": [1],
            f"p.{pair}": [0.9],
            **{f"size.{pair}.{fault}": [0.25] for fault in pair.split("+")},
            **{f"size_sd.{pair}.{fault}": [0.01] for fault in pair.split("+")},
        }
    )
    verdict = Verdict(log=log.name, recipe="diesel_airpath", detector=None, fault=pair, signal="p_Bst+W_HFM")
    group = corrected(log, samples, verdict, detector)
    assert group is not None
    for signal in ("p_Bst", "W_HFM"):
        np.testing.assert_allclose(group.frame[f"{signal}.corrected"], log.values(signal) / 1.25)
    assert corrected(log, samples, replace(verdict, signal=None), detector) is None
