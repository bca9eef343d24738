"""Wavelet shrinkage: what it takes away and what it leaves."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.denoise import Denoise, shrink
from stages.stage import ANALYSIS, transform

pytest.importorskip("pywt", reason="PyWavelets is not installed")


def test_noise_goes_and_the_signal_stays() -> None:
    t = np.linspace(0, 1, 2048)
    truth = np.sin(6 * t) + (t > 0.4)
    noisy = truth + np.random.default_rng(0).normal(0, 0.1, t.size)
    assert np.std(shrink(noisy) - truth) < 0.4 * np.std(noisy - truth)
    np.testing.assert_allclose(shrink(truth), truth, atol=0.02)


def test_pure_noise_vanishes_but_for_the_coarsest_part() -> None:
    """The universal threshold is the expected maximum of N normal values (Donoho and Johnstone, 1994)."""
    x = np.random.default_rng(1).normal(size=4096)
    assert np.std(shrink(x)) < 0.15


def test_windows_are_taken_one_by_one() -> None:
    x = np.random.default_rng(2).normal(size=150)
    x[70] = np.nan
    log = Log("a", {ANALYSIS: Group(ANALYSIS, pl.DataFrame({"time": np.arange(150.0), "x": x}))})
    out = transform([Denoise(columns=("x",), samples=64)], log).groups[ANALYSIS].frame["x"].to_numpy()
    assert out.size == 128
    np.testing.assert_allclose(out[:64], shrink(x[:64]))
    np.testing.assert_array_equal(out[64:], x[64:128])  # a window with a missing value passes


def test_wrong_settings_are_told() -> None:
    with pytest.raises(RecipeError, match="16 samples or more"):
        Denoise(columns=("x",), samples=8)
