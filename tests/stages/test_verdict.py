from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.log import Event, Group, Log
from stages.results import Verdict
from stages.verdict import Judge, onset

RATE = 0.5


def samples(
    n: int = 1200, *, alarms: tuple[tuple[int, int], ...] = (), shift_from: int | None = None
) -> pl.DataFrame:
    rng = np.random.default_rng(0)
    detection = np.zeros(n, dtype=np.int8)
    for a, b in alarms:
        detection[a:b] = 1
    e = rng.normal(0, 0.1, n) + (0.3 * (np.arange(n) >= shift_from) if shift_from is not None else 0.0)
    strength = np.where(np.arange(n) < 500, 10.0, 20.0)
    return pl.DataFrame(
        {
            "time": RATE * np.arange(n),
            "in_domain": np.ones(n, dtype=bool),
            "residual.r": e,
            "sigma.r": np.full(n, 0.1),
            "z.r": e / 0.1,
            "detection": detection,
            "evidence.leak": strength * (np.arange(n) < 500),
            "evidence.gain": strength * (np.arange(n) >= 500),
            "p.leak": np.where(np.arange(n) < 500, 0.97, 0.01) * detection,
            "p.gain": np.where(np.arange(n) < 500, 0.02, 0.9) * detection,
            "p.unknown": np.where(np.arange(n) < 500, 0.01, 0.09) * detection,
        }
    )


def verdict_of(frame: pl.DataFrame, *, min_evidence_s: float = 45.0) -> Verdict:
    log = Log(
        "x", {"a": Group("a", frame.select("time"))}, (Event(t_start=1.0, kind="leak", source="truth"),)
    )
    judge = Judge(channels={"gain": "W_HFM"}, min_evidence_s=min_evidence_s)
    return judge.verdict(log, frame, recipe="r", detector="k", quality={})


def test_no_alarm() -> None:
    assert verdict_of(samples()).fault == "none"
    assert verdict_of(samples(80)).fault == "insufficient_evidence"
    assert verdict_of(samples(80), min_evidence_s=30).fault == "none"
    assert verdict_of(samples()).statistics["truth"] == ["leak"]


def test_the_strongest_event_decides_and_all_are_listed() -> None:
    verdict = verdict_of(samples(alarms=((200, 300), (600, 800))))
    assert verdict.fault == "gain"
    assert verdict.signal == "W_HFM"
    assert verdict.set == ("gain", "unknown")
    assert verdict.detected_s == 300.0
    assert [e.kind for e in verdict.events] == ["leak", "gain"]
    assert [e.t_end for e in verdict.events] == [149.5, 399.5]


def test_close_alarms_are_one_event_and_an_open_one_has_no_end() -> None:
    verdict = verdict_of(samples(alarms=((600, 700), (712, 800), (815, 1200))))
    assert len(verdict.events) == 1
    assert verdict.events[0].t_end is None


def test_json_has_the_keys_that_are_documented() -> None:
    keys = (
        "log recipe detector fault signal set probability onset_s detected_s magnitude detectable events "
        "quality statistics"
    )
    assert set(verdict_of(samples(alarms=((600, 800),))).to_json()) == set(keys.split())


@pytest.mark.parametrize("true_row", [100, 400, 700])
def test_onset_is_found(true_row: int) -> None:
    frame = samples(shift_from=true_row)
    assert onset(frame, true_row + 25) == pytest.approx(RATE * true_row, abs=3.0)


def test_two_faults_have_two_sizes_where_they_are_known() -> None:
    frame = samples(alarms=((600, 1200),)).rename(
        {"p.gain": "p.gain+leak", "evidence.gain": "evidence.gain+leak"}
    )
    sizes = {"size.gain+leak.gain": 0.05, "size_sd.gain+leak.gain": 0.01, "size.gain+leak.leak": None}
    frame = frame.with_columns(pl.lit(x, dtype=pl.Float32).alias(c) for c, x in sizes.items())
    frame = frame.with_columns(pl.lit(None, dtype=pl.Float32).alias("size_sd.gain+leak.leak"))
    verdict = verdict_of(frame)
    assert (verdict.fault, verdict.signal, verdict.magnitude) == ("gain+leak", "W_HFM", None)
    found = verdict.statistics["magnitudes"]
    assert [*found] == ["gain"]
    assert found["gain"]["value"] == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("group", "same"),
    [
        (("gain", "leak", "other"), ["leak+other"]),
        (("other", "leak", "third"), None),
        (("gain", "leak"), None),
    ],
)
def test_two_faults_that_look_like_the_one_named_are_said(
    group: tuple[str, ...], same: list[str] | None
) -> None:
    frame, log = samples(alarms=((600, 1200),)), Log("x", {})
    judge = Judge(alike=(group,))
    found = judge.verdict(log, frame, recipe="r", detector="k", quality={})
    assert (found.fault, found.statistics.get("same_as")) == ("gain", same)
    none = judge.verdict(log, samples(alarms=()), recipe="r", detector="k", quality={})
    assert "same_as" not in none.statistics


def scattering() -> pl.DataFrame:
    """Evident from row 590 on, of ``T_Int`` most, in alarm from row 600 on."""
    n = np.arange(1200)
    frame = samples(alarms=((600, 1200),))
    return frame.with_columns(
        pl.Series("p.sensor_noise", np.where(n >= 600, 1.0, 0.0)),
        pl.Series("evidence.sensor_noise", np.where(n >= 590, 60.0, 0.0)),
        pl.Series("sensor.sensor_noise.W_HFM", np.where(n >= 590, 1.0, 0.0)),
        pl.Series("sensor.sensor_noise.T_Int", np.where(n >= 590, 40.0, 0.0)),
        pl.lit(0.0).alias("p.gain"),
    )


def test_of_a_fault_that_several_sensors_can_have_the_most_evident_one_is_told() -> None:
    verdict = verdict_of(scattering())
    assert (verdict.fault, verdict.signal, verdict.set) == (
        "sensor_noise",
        "T_Int",
        ("sensor_noise", "unknown"),
    )
    assert verdict.magnitude is None
    assert verdict.onset_s == 590 * RATE  # when it began to be evident, not when residuals shifted
    sized = scattering().with_columns(
        pl.lit(12.0).alias("size.sensor_noise.T_Int"), pl.lit(0.5).alias("size_sd.sensor_noise.T_Int")
    )
    size = verdict_of(sized).magnitude
    assert size is not None
    assert (size.value, size.sd) == (12.0, 0.5)
