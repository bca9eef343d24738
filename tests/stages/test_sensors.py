"""Sensors that scatter or do not move, on made-up signals; and all that looks like it and is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import Group, Log
from stages.align import Align
from stages.roughness import Roughness
from stages.sensors import Sensors
from stages.stage import ANALYSIS, Stage, transform

SIGNALS = ("p", "T")
RATE = 50.0
FIRST = (Align(signals=("p", "T", "n", "q")), Roughness(signals=SIGNALS))
AVERAGED = Align(signals=("p", "T", "n", "q", "sample_s", "rough.p", "rough.T"), raster_s=0.5)
ON = 300.0  # s


def drive(
    seed: int, *, step_K: float = 0.0, rate: float = RATE, duration_s: float = 600.0, moves: bool = True
) -> pl.DataFrame:
    """A pressure that moves and rests in turn, its twin ``q``, a temperature, with white noise of 0.3 % and
    0.1 K; that of a coarse sensor comes in steps."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration_s, 1 / rate)
    steps = rng.uniform(0, 1, int(duration_s / 20) + 1).round(1) if moves else np.full(1000, 0.5)
    moving = 100 * (1 + np.interp(t, 20.0 * np.arange(len(steps)), steps))
    p, q = (moving * (1 + rng.normal(0, 0.003, t.size)) for _ in range(2))
    T = 300 + 10 * np.sin(t / 40 + seed) + rng.normal(0, 0.1, t.size) * (step_K == 0)
    if step_K:
        T = step_K * np.round(T / step_K)
    return pl.DataFrame({"time": t, "p": p, "q": q, "T": T, "n": np.full(t.size, 1000.0)})


def averaged(frame: pl.DataFrame) -> Log:
    return transform([*FIRST, AVERAGED], Log("made", {"ecu": Group("ecu", frame)}))


def fitted(step_K: float = 0.0) -> Sensors:
    return Sensors(signals=SIGNALS, where="n - 400", expected={"p": "q"}).fit(
        [averaged(drive(s, step_K=step_K)) for s in (1, 2)]
    )


@pytest.fixture(scope="module")
def sensors() -> Sensors:
    return fitted()


def said(sensors: Stage, frame: pl.DataFrame) -> pl.DataFrame:
    return transform([sensors], averaged(frame)).groups[ANALYSIS].frame


def changed(frame: pl.DataFrame, column: str, x: NDArray[np.float64]) -> pl.DataFrame:
    return frame.with_columns(pl.Series(column, np.where(frame["time"] < ON, frame[column], x)))


def named(frame: pl.DataFrame, fault: str, signal: str) -> bool:
    """Nothing before the fault; from 30 s after it on this fault alone, of this sensor."""
    assert frame.filter(pl.col("time") < ON)["detection"].max() == 0
    late = frame.filter(pl.col("time") > ON + 30)
    other = next(s for s in SIGNALS if s != signal)
    evident = (late[f"sensor.{fault}.{signal}"] > late[f"sensor.{fault}.{other}"]).all()
    return bool((late[f"p.{fault}"] > 0.95).all() and evident and (late["detection"] == 1).all())


@pytest.mark.parametrize("signal", SIGNALS)
def test_more_noise_is_named(sensors: Sensors, signal: str) -> None:
    frame = drive(3)
    rng = np.random.default_rng(0)
    scattered = frame[signal].to_numpy() * (1 + 0.01 * rng.standard_normal(frame.height))
    assert named(said(sensors, changed(frame, signal, scattered)), "sensor_noise", signal)


@pytest.mark.parametrize("signal", SIGNALS)
@pytest.mark.parametrize("value", [200.0, 0.0])
def test_a_sensor_that_does_not_move_is_named(sensors: Sensors, signal: str, value: float) -> None:
    frame = drive(3)
    held = np.full(frame.height, value)
    assert named(said(sensors, changed(frame, signal, held)), "sensor_stuck", signal)


def test_one_that_stands_still_but_for_its_converter_is_named(sensors: Sensors) -> None:
    frame = drive(3)
    noise = 0.02 * np.random.default_rng(0).standard_normal(frame.height)  # a fifteenth of its usual
    assert named(said(sensors, changed(frame, "p", 150 + noise)), "sensor_stuck", "p")


def silent(frame: pl.DataFrame) -> bool:
    return frame["detection"].max() == 0 and frame.select(pl.max_horizontal("^p[.].*$").max()).item() == 0


@pytest.mark.parametrize("seed", range(3, 9))
def test_other_drives_raise_no_alarm(sensors: Sensors, seed: int) -> None:
    assert silent(said(sensors, drive(seed)))


def test_a_log_that_hardly_moves_raises_no_alarm_nor_does_a_scattering_twin(sensors: Sensors) -> None:
    still = drive(3, moves=False)
    assert silent(said(sensors, still))
    q = still["q"].to_numpy() * (1 + 0.1 * np.random.default_rng(0).standard_normal(still.height))
    assert silent(said(sensors, changed(drive(3), "q", q)))


def test_a_coarse_sensor_may_repeat_itself() -> None:
    coarse = fitted(step_K=2.0)
    for seed in range(3, 9):
        assert silent(said(coarse, drive(seed, step_K=2.0)))
    frame = drive(3, step_K=2.0, duration_s=1200.0)
    late = said(coarse, changed(frame, "T", np.full(frame.height, 304.0))).tail(1).row(0, named=True)
    assert late["p.sensor_stuck"] > 0.95  # after three times its longest rest
    assert late["sensor.sensor_stuck.T"] > late["sensor.sensor_stuck.p"]


def test_spikes_gaps_and_missing_values_raise_no_alarm(sensors: Sensors) -> None:
    frame = drive(3)
    spiked = frame["p"].to_numpy().copy()
    spiked[15000:20000:700] *= 2  # one in 14 s
    missing = (pl.col("time") > 400) & (pl.col("time") < 430)
    frame = changed(frame, "p", spiked).with_columns(
        pl.when(missing).then(None).otherwise(pl.col("T")).alias("T")
    )
    assert silent(said(sensors, frame.filter(~pl.col("time").is_between(450, 500))))


def test_a_logger_or_an_engine_that_stands_is_no_fault(sensors: Sensors) -> None:
    frame = drive(3)
    stands = frame
    for c in ("p", "q", "T", "n"):
        stands = changed(stands, c, np.full(frame.height, frame[c][14999]))
    assert silent(said(sensors, stands))
    off = changed(changed(frame, "p", np.full(frame.height, 97.0)), "n", np.zeros(frame.height))
    assert silent(said(sensors, off))


def test_noise_is_not_judged_at_another_rate(sensors: Sensors) -> None:
    frame = drive(3, rate=10.0)
    assert silent(said(sensors, frame))
    scattered = frame["p"].to_numpy() * (1 + 0.05 * np.random.default_rng(0).standard_normal(frame.height))
    assert silent(said(sensors, changed(frame, "p", scattered)))


def test_other_faults_keep_their_odds_and_say_no_more_than_the_sensor(sensors: Sensors) -> None:
    frame = drive(3)
    block = averaged(changed(frame, "p", np.full(frame.height, 150.0)))
    known = pl.DataFrame({"detection": 1, "p.a": 0.8, "p.b": 0.2, "evidence.a": 500.0, "evidence.b": 497.0})
    group = block.groups[ANALYSIS]
    table = group.frame.join(known, how="cross")
    block = replace(block, groups={ANALYSIS: Group(ANALYSIS, table, group.signals)})
    out = transform([sensors], block).groups[ANALYSIS].frame
    before, late = out.filter(pl.col("time") < ON), out.filter(pl.col("time") > ON + 30)
    np.testing.assert_allclose(
        before.select("p.a", "p.b").to_numpy(), [[0.8, 0.2]] * before.height, rtol=1e-6
    )
    np.testing.assert_allclose(late["p.a"] / late["p.b"], 4.0, rtol=1e-5)
    np.testing.assert_allclose(out.select(pl.sum_horizontal("^p[.].*$")).to_series(), 1.0, atol=1e-6)
    assert (late["evidence.sensor_stuck"] > 512).all()
    assert (late["p.sensor_stuck"] > 0.95).all()


def test_mistakes() -> None:
    with pytest.raises(RecipeError, match="name at least one signal"):
        Sensors(signals=())
    with pytest.raises(RecipeError, match="expected 'q' is no signal"):
        Sensors(signals=("p",), expected={"q": "1"})
    with pytest.raises(LogError, match=r"'p' has no value .* where 'n - 5000' is positive"):
        Sensors(signals=SIGNALS, where="n - 5000").fit([averaged(drive(1))])
