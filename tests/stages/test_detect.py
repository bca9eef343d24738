"""Detect against closed forms of its statistic, and its false-alarm rate on what it was calibrated for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.detect import MEAN, MEAN_SD, Detect, between_runs
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA
from stages.results import DETECTION, STATISTIC
from stages.stage import ANALYSIS, columns, transform

DT, SIGMA_VALUE = 0.5, 0.1


def residual_log(e: np.ndarray, *, doubt: float = 0.0, dt: float = DT, name: str = "x") -> Log:
    frame = pl.DataFrame(
        {
            "time": dt * np.arange(e.size),
            RESIDUAL + "r": e,
            MODEL_SD + "r": np.full(e.size, doubt),
            SIGMA + "r": np.full(e.size, SIGMA_VALUE),
        }
    )
    return Log(name, {ANALYSIS: Group(ANALYSIS, frame)})


def noise(seed: int, n: int = 2400) -> np.ndarray:
    """Noise correlated over tau_c = 2 s, as the statistic assumes: independent values held for 2 s."""
    return np.repeat(np.random.default_rng(seed).normal(0, SIGMA_VALUE, n // 4 + 1), 4)[:n]


def fitted(offset: float = 0.0, threshold: float = 4.0, **settings: object) -> Detect:
    stage = Detect(**settings)  # type: ignore[arg-type]
    limits = np.full((len(stage.memories_s), 1), threshold)
    return replace(stage, learned={"offset": np.array([offset]), "threshold": limits})


def test_the_remembered_mean_and_its_spread_are_exponential_sums() -> None:
    e = noise(0)[:400]
    stage = fitted(offset=0.03, threshold=1e9, memories_s=(30.0,))
    out = columns(transform([stage], residual_log(e, doubt=0.02)))
    age = DT * np.arange(400)[::-1]
    weight = np.exp(-age / 30.0) * (DT / 2.0) / SIGMA_VALUE**2
    weight[0] *= 4  # the first sample stands for a whole correlation time
    noise_part = (np.exp(-age / 30.0) * weight).sum() / weight.sum() ** 2
    assert out[MEAN + "r"][-1] == pytest.approx(weight @ e / weight.sum())
    assert out[MEAN_SD + "r"][-1] == pytest.approx(np.sqrt(noise_part + 0.02**2 + 0.03**2))
    assert 1e9 * out[STATISTIC][-1] == pytest.approx(abs(out[MEAN + "r"][-1]) / out[MEAN_SD + "r"][-1])


def test_healthy_statistic_is_standard_normal() -> None:
    stage = fitted(threshold=1e9, memories_s=(30.0,))
    z = [columns(transform([stage], residual_log(noise(s))))[MEAN + "r"][200::400] for s in range(60)]
    sd = columns(transform([stage], residual_log(noise(0))))[MEAN_SD + "r"][200::400]
    assert np.std(np.stack(z) / sd) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("dt", [0.05, 0.5, 1.0, 2.0])
def test_evidence_does_not_depend_on_the_sampling_rate(dt: float) -> None:
    e = np.full(int(120 / dt), 0.05)
    out = columns(transform([fitted(threshold=1e9, memories_s=(30.0,))], residual_log(e, dt=dt)))
    assert 1e9 * out[STATISTIC][-1] == pytest.approx(0.05 / SIGMA_VALUE * np.sqrt(2 * 30.0 / 2.0), rel=0.05)


def test_no_alarm_on_what_it_was_calibrated_for_and_few_on_fresh_drives() -> None:
    stage = Detect(min_threshold=3.0).fit([residual_log(noise(s)) for s in range(20)])
    alarms = [columns(transform([stage], residual_log(noise(s))))[DETECTION].any() for s in range(100, 160)]
    assert sum(alarms) <= 2


def test_a_shift_is_found_soon_and_the_alarm_ends_with_it() -> None:
    stage = Detect().fit([residual_log(noise(s)) for s in range(10)])
    e = noise(50)
    e[1000:1600] += 3 * SIGMA_VALUE  # 500 s to 800 s
    out = columns(transform([stage], residual_log(e)))
    on = out["time"][out[DETECTION] > 0]
    assert 500 < on[0] < 515
    assert on[-1] < 800 + 3 * 300  # the longest memory must forget it
    assert (out[DETECTION][:1000] == 0).all()


def test_the_episode_is_not_blurred_by_what_was_before() -> None:
    e = noise(51)
    e[1000:] += 5 * SIGMA_VALUE
    out = columns(transform([Detect().fit([residual_log(noise(1))])], residual_log(e)))
    assert out[MEAN + "r"][1120] == pytest.approx(5 * SIGMA_VALUE, rel=0.2)


def test_scatter_between_runs_is_seen_and_noise_is_not() -> None:
    rng = np.random.default_rng(3)
    runs = [residual_log(noise(s) + rng.normal(0, 0.05)) for s in range(40)]
    assert between_runs(runs, "r", 300.0, 2.0) == pytest.approx(0.05, rel=0.3)
    assert between_runs([residual_log(noise(s)) for s in range(40)], "r", 300.0, 2.0) < 0.01
    assert Detect(offset={"r": 0.2}).fit(runs).learned["offset"][0] == 0.2


def test_memories_increase() -> None:
    with pytest.raises(RecipeError, match=r"increasing, got \[30, 10\]"):
        Detect(memories_s=(30, 10))
