"""The pictures of the tabs Distributions and Model say what the samples say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from recordings import static

from stages.results import Diagnosis
from viz.colours import BLUE, VERMILLION
from viz.distributions import AGAINST, BY_REGIME, CDF, LEADS
from viz.model import MODEL, model_text
from viz.plane import CELL, HEIGHT, ROW, WIDTH
from viz.statistics import abscissa, regime_signature, telling
from viz.timeline import write_timeline


@pytest.fixture(scope="module")
def found(diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[object]]:
    path = tmp_path_factory.mktemp("run") / "t.rrd"
    write_timeline(diagnosis, path)
    return static(path)


def test_the_distribution_is_that_of_the_samples(
    found: dict[str, list[object]], diagnosis: Diagnosis
) -> None:
    strips = [np.array(s) for s in found[f"{CDF}/lines LineStrips2D:strips"]]
    assert len(strips) == 4  # two residuals, in and out of alarm
    first = telling(diagnosis.samples)[0]
    z = diagnosis.samples.filter(pl.col("detection") == 1)[f"z.{first}"].to_numpy()
    x, share = (strips[1] / (WIDTH, -HEIGHT)).T
    for at, said in zip(24.0 * x - 12.0, share, strict=True):
        assert said == pytest.approx((z <= at + 1e-4).mean(), abs=2e-3)


def test_the_matrix_has_the_mean_of_each_residual_in_each_regime(
    found: dict[str, list[object]], diagnosis: Diagnosis
) -> None:
    regimes, residuals, means = regime_signature(diagnosis.samples)
    assert (len(residuals), len(regimes)) == means.shape
    alarm = diagnosis.samples.filter(pl.col("detection") == 1)
    for j, regime in enumerate(regimes):
        own = alarm.filter(pl.col("regime") == regime)
        if own.height >= 3:
            assert means[0, j] == pytest.approx(own[f"z.{residuals[0]}"].mean())
    words = found[f"{BY_REGIME}/numbers Points2D:labels"]
    assert len(words) == int(np.isfinite(means).sum())
    pixels = np.array(found[f"{BY_REGIME}/fields Image:buffer"][0], dtype=np.uint8)
    pixels = pixels.reshape(len(residuals) * ROW, len(regimes) * CELL, 3)
    deepest = np.unravel_index(np.nanargmin(means), means.shape)
    shade = pixels[deepest[0] * ROW + 4, deepest[1] * CELL + 5].astype(int)
    assert np.abs(shade - BLUE).sum() < np.abs(shade - VERMILLION).sum()


def test_residuals_stand_against_the_pressure_ratio(
    found: dict[str, list[object]], diagnosis: Diagnosis
) -> None:
    beside = abscissa(diagnosis)
    assert beside is not None
    label, x = beside
    assert label == "pressure ratio p_Bst / p_Int"
    frame = diagnosis.log.groups["fast"].frame.gather_every(5)
    np.testing.assert_allclose(x, (frame["p_Bst"] / frame["p_Int"]).to_numpy())
    assert f"{AGAINST}/samples Points2D:positions" in found


def test_the_other_hypotheses_are_ranked(found: dict[str, list[object]]) -> None:
    lines = str(found[f"{LEADS} TextDocument:text"][0]).splitlines()
    ranked = [line.split("|")[1].strip() for line in lines if line.startswith("| ")][2:]
    assert ranked[0] == "intake_leak"
    assert set(ranked) == {"none", "maf_gain", "boost_pressure_gain", "intake_pressure_gain", "intake_leak"}


def test_the_model_is_described(found: dict[str, list[object]], diagnosis: Diagnosis) -> None:
    text = str(found[f"{MODEL} TextDocument:text"][0])
    assert diagnosis.about is not None
    assert text == model_text(diagnosis.about, "diesel_airpath", "3f9a12c0")
    assert "| f_Cyl | W_Cyl | p_Int, n_Eng | recipe | 8 | 0.28 g/s |" in text
    assert "| r_dp | p_Bst - p_Int - f_dp |" in text


def test_a_quiet_log_without_regimes_has_its_pictures_too(diagnosis: Diagnosis, tmp_path: Path) -> None:
    samples = diagnosis.samples.drop("regime", "in_domain").with_columns(detection=pl.lit(0, pl.Int8))
    quiet = replace(diagnosis, samples=samples, operating_map=None, about=None)
    write_timeline(quiet, tmp_path / "t.rrd")
    assert MODEL not in {key.split()[0] for key in static(tmp_path / "t.rrd")}
    assert regime_signature(samples)[0] == []
