"""Corrected readings against the healthy ones that the simulator knows."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.compensate import Compensate
from stages.stage import ANALYSIS, transform

Array = NDArray[np.float64]
STAGE = Compensate(signal="y", sensor="s", faults={"weak": "gain", "slow": "time_constant"}, max_gap_s=0.05)
DT, TAU = 0.01, 0.02
WINDOWED = ("indicator.tau_s", "sigma.tau_s", "z.tau_s", "noise_sd")  # null without a fit


def block(
    y: Array, fault: str, size: float, *, rate: float = 0.0, since: float = 1.0, noise: float = 0.0
) -> Log:
    """Readings, and windows of 1 s of which those that end at ``since`` or later isolate a fault."""
    ends = np.arange(1.0, y.size * DT + 0.5)
    on = ends >= since
    eta = np.log1p(size) + rate * (ends - since)
    columns = {
        "indicator.tau_s": np.full(ends.size, TAU), "sigma.tau_s": np.full(ends.size, 0.001),
        "z.tau_s": np.zeros(ends.size), "noise_sd": np.full(ends.size, noise),
    }  # fmt: skip
    for name in STAGE.faults:
        this = name == fault
        columns |= {
            f"p.{name}": on * float(this), f"size.{name}": np.expm1(eta) if this else 0 * eta,
            f"size_sd.{name}": np.full(ends.size, 0.01), f"rate.{name}": np.full(ends.size, rate * this),
        }  # fmt: skip
    windows = pl.DataFrame({"time": ends, **columns})
    signals = pl.DataFrame({"time": DT * np.arange(y.size), "y": y})
    return Log("made", {ANALYSIS: Group(ANALYSIS, windows), "signals": Group("signals", signals)})


def corrected(log: Log, block_s: float | None = None) -> tuple[Array, Array]:
    frame = transform([STAGE], log, block_s).groups["signals"].frame
    return frame["y.corrected"].to_numpy(), frame["y.corrected_sd"].to_numpy()


def test_gain_is_undone_after_the_isolation_only_and_follows_its_trend() -> None:
    truth = np.sin(np.arange(500) * 0.05) + 2.0
    time = DT * np.arange(500)
    gain = np.where(time >= 2.0, 0.8 * np.exp(-0.05 * (time - 2.0)), 1.0)
    c, sd = corrected(block(gain * truth, "weak", -0.2, rate=-0.05, since=2.0))
    np.testing.assert_allclose(c, truth, rtol=1e-9)
    np.testing.assert_allclose(
        sd[250:], truth[250:] * 0.01 / (1 - 0.2) / np.exp(-0.05 * np.floor(time[250:] - 2.0)), rtol=1e-9
    )
    before = corrected(block(gain * truth, "weak", -0.2, since=99.0))[0]
    np.testing.assert_array_equal(before, gain * truth)


def sensor(x: Array, tau: float) -> Array:
    """A first-order sensor on an input held from sample to sample."""
    a = np.exp(-DT / tau)
    reading: Array = lfilter([0.0, 1.0 - a], [1.0, -a], x)
    return reading


@pytest.mark.parametrize("size", [0.5, -0.3])
def test_slow_sensor_reads_as_a_healthy_one(size: float) -> None:
    x = np.random.default_rng(0).normal(size=1000)
    c, _ = corrected(block(sensor(x, TAU * (1 + size)), "slow", size))
    np.testing.assert_allclose(c[150:], sensor(x, TAU)[150:], atol=1e-9)


def test_amplified_noise_is_that_of_the_filter() -> None:
    noise = np.random.default_rng(1).normal(0, 0.1, 60_000)
    c, sd = corrected(block(noise, "slow", 1.0, noise=0.1))
    inside = slice(1000, None)
    assert c[inside].std() == pytest.approx(np.median(sd[inside]), rel=0.05)
    assert c[inside].std() > 0.12


def test_blocks_gaps_and_missing_readings() -> None:
    y = sensor(np.random.default_rng(2).normal(size=600), 2 * TAU)
    y[300:310] = np.nan
    log = block(y, "slow", 1.0)
    signals = log.groups["signals"]
    log = Log(
        "gap",
        {
            **log.groups,
            "signals": Group("signals", signals.frame.filter(~pl.col("time").is_between(4.0, 4.5))),
        },
    )
    whole, cut_up = corrected(log)[0], corrected(log, 0.37)[0]
    np.testing.assert_array_equal(whole, cut_up)
    np.testing.assert_array_equal(np.isnan(whole), log.groups["signals"].frame["y"].is_nan().fill_null(True))


@pytest.mark.parametrize("settings", [{"faults": {}}, {"confidence": 1.5}])
def test_wrong_settings_are_told(settings: dict[str, object]) -> None:
    with pytest.raises(RecipeError, match="confidence between 0 and 1"):
        Compensate(**{"signal": "y", "sensor": "s", "faults": {"weak": "gain"}} | settings)  # type: ignore[arg-type]


def test_a_window_that_could_not_be_fitted_keeps_what_was_known() -> None:
    x = np.random.default_rng(3).normal(size=500)
    log = block(sensor(x, 2 * TAU), "slow", 1.0)
    windows = log.groups[ANALYSIS]
    unknown = [pl.when(pl.col("time") > 2.5).then(None).otherwise(c).alias(c) for c in WINDOWED]
    bare = Group(ANALYSIS, windows.frame.with_columns(unknown))
    np.testing.assert_array_equal(
        corrected(Log("bare", {**log.groups, ANALYSIS: bare}))[0], corrected(log)[0]
    )
