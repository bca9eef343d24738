"""Roughness of made-up signals: the variance of white noise, nothing of a slow change, nothing over a gap."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.errors import RecipeError
from ingest.log import Group, Log, Signal
from stages.roughness import Roughness
from stages.stage import ANALYSIS, transform

TIME = np.arange(0, 200, 0.02)


def found(x: np.ndarray, time: np.ndarray = TIME, block_s: float | None = None) -> pl.DataFrame:
    group = Group(ANALYSIS, pl.DataFrame({"time": time, "x": x}), {"x": Signal(name="x", unit="kPa")})
    out = transform([Roughness(signals=("x",))], Log("made", {ANALYSIS: group}), block_s).groups[ANALYSIS]
    assert out.signals["rough.x"].unit == "(kPa)^2"
    return out.frame


def test_its_mean_is_the_variance_of_white_noise_whatever_the_signal_does_slowly() -> None:
    rng = np.random.default_rng(0)
    x = 100 + 30 * np.sin(TIME / 5) + rng.normal(0, 0.2, TIME.size)
    assert found(x)["rough.x"].fill_nan(None).mean() == pytest.approx(0.04, rel=0.05)
    still = found(100 + 30 * np.sin(TIME / 5))["rough.x"].fill_nan(None).max()
    assert isinstance(still, float)
    assert still < 1e-6


def test_the_first_samples_and_those_after_a_gap_say_nothing() -> None:
    keep = (TIME < 50) | (TIME > 60)
    frame = found(np.random.default_rng(0).normal(size=keep.sum()), TIME[keep])
    silent = frame.filter(pl.col("rough.x") == 0)["time"].to_numpy()
    np.testing.assert_allclose(silent, [0.0, 0.02, 60.02, 60.04])


def test_a_missing_reading_spoils_three() -> None:
    x = np.sin(TIME)
    x[100] = np.nan
    missing = found(x)["rough.x"].fill_nan(None).is_null()
    assert missing.arg_true().to_list() == [100, 101, 102]


def test_blocks_do_not_matter() -> None:
    x = np.random.default_rng(1).normal(size=TIME.size)
    assert found(x).equals(found(x, block_s=0.3), null_equal=True)


def test_mistakes() -> None:
    with pytest.raises(RecipeError, match="at least one signal"):
        Roughness(signals=())
    with pytest.raises(RecipeError, match="max_gap_s = 0"):
        Roughness(signals=("x",), max_gap_s=0.0)
