"""The isolated sensor's readings, corrected from the isolation on and not before."""

from __future__ import annotations

import numpy as np
import polars as pl

from ingest.log import Group, Log
from stages.accommodate import accommodate
from stages.hypotheses import Hypothesis

HYPOTHESES = {
    "gain": Hypothesis(undo={"p": "p / (1 + theta)"}, sizes=(-0.1, 0.1), signal="p"),
    "leak": Hypothesis(undo={"leak": "theta"}, sizes=(1.0, 2.0), unit="mm"),
}
TIME = np.arange(0, 100, 0.02)
TRUE = 100 + 10 * np.sin(TIME)
LOG = Log(
    "x", {"ecu": Group("ecu", pl.DataFrame({"time": TIME, "p": np.where(TIME >= 30, 1.05 * TRUE, TRUE)}))}
)


def samples(fault: str, at: float = 40.0, p: float = 0.9) -> pl.DataFrame:
    """A diagnosis every half second that names ``fault`` from ``at`` s on."""
    t = np.arange(0, 100, 0.5)
    on = t >= at
    share = {f: p if f == fault else (1 - p) / 2 for f in ("gain", "leak", "unknown")}
    return pl.DataFrame(
        {
            "time": t,
            "detection": on.astype(np.int8),
            **{f"p.{f}": np.where(on, x, 0.0) for f, x in share.items()},
            **{f"size.{f}": np.full(t.size, 0.048) for f in HYPOTHESES},
            **{f"size_sd.{f}": np.full(t.size, 0.002) for f in HYPOTHESES},
        }
    )


def test_the_reading_is_corrected_from_the_isolation_on() -> None:
    group = accommodate(LOG, samples("gain"), "p", HYPOTHESES)
    assert group is not None
    raw, corrected, sd = (group.frame[c].to_numpy() for c in ("p", "p.corrected", "p.corrected_sd"))
    late = TIME >= 40
    np.testing.assert_array_equal(corrected[~late], raw[~late])
    assert (sd[~late] == 0).all()
    error, before = np.abs(corrected - TRUE)[late], np.abs(raw - TRUE)[late]
    assert np.sqrt(np.mean(before**2)) > 5 * np.sqrt(np.mean(error**2))
    np.testing.assert_allclose(sd[late], 0.0019 * TRUE[late], rtol=0.05)
    assert (error < 2 * sd[late]).all()


def test_another_fault_or_a_doubtful_one_corrects_nothing() -> None:
    for frame in (samples("leak"), samples("gain", p=0.4)):
        group = accommodate(LOG, frame, "p", HYPOTHESES)
        assert group is not None
        assert group.frame["p.corrected"].equals(group.frame["p"], null_equal=True)


def doubtful(gain: float, both: float, size: float = 0.04) -> pl.DataFrame:
    """A gain alone or beside a leak, when it would be of another ``size``."""
    frame = samples("gain", p=gain)
    on = frame["detection"].to_numpy()
    sizes = {"size.gain+leak.gain": pl.lit(size), "size_sd.gain+leak.gain": pl.lit(0.002)}
    share = {"p.gain+leak": both * on, "p.unknown": (1 - gain - both) * on, "p.leak": 0.0 * on}
    return frame.with_columns(**{c: pl.Series(p) for c, p in share.items()}, **sizes)


def test_an_isolated_sensor_is_corrected_though_it_is_open_what_else_is_wrong() -> None:
    group = accommodate(LOG, doubtful(0.4, 0.3), "p", HYPOTHESES)
    assert group is not None
    raw, corrected, sd = (
        group.frame[c].to_numpy()[TIME >= 40] for c in ("p", "p.corrected", "p.corrected_sd")
    )
    alone, beside = raw / 1.048, raw / 1.04
    np.testing.assert_allclose(corrected, (0.4 * alone + 0.3 * beside) / 0.7)
    apart = np.sqrt(0.4 * 0.3) / 0.7 * (beside - alone)
    assert (sd > apart).all()
    assert (sd < np.hypot(apart, 0.0025 * raw)).all()


def test_of_two_sensors_that_may_be_wrong_neither_is_corrected() -> None:
    group = accommodate(LOG, doubtful(0.3, 0.15), "p", HYPOTHESES)
    assert group is not None
    assert (group.frame["p"] == group.frame["p.corrected"]).all()


def test_a_supposition_without_a_size_does_not_say_how_to_correct() -> None:
    group = accommodate(LOG, doubtful(0.4, 0.3, size=np.nan), "p", HYPOTHESES)
    assert group is not None
    late = TIME >= 40
    np.testing.assert_allclose(
        group.frame["p.corrected"].to_numpy()[late], group.frame["p"].to_numpy()[late] / 1.048
    )


def test_a_size_at_the_end_of_its_grid_corrects_with_a_spread_that_is_not_known() -> None:
    frame = samples("gain").with_columns(pl.lit(np.nan).alias("size_sd.gain"))
    group = accommodate(LOG, frame, "p", HYPOTHESES)
    assert group is not None
    late = group.frame.filter(pl.col("time") >= 40)
    np.testing.assert_allclose(late["p.corrected"], late["p"] / 1.048)
    assert late["p.corrected_sd"].is_nan().all()


def test_a_fault_that_is_no_sensors_has_no_correction() -> None:
    assert accommodate(LOG, samples("leak"), "leak", HYPOTHESES) is None


def test_without_samples_nothing_is_corrected() -> None:
    group = accommodate(LOG, samples("gain").clear(), "p", HYPOTHESES)
    assert group is not None
    assert group.frame["p.corrected"].equals(group.frame["p"])


OFFSET = {
    "sensor_offset": {"p": Hypothesis(undo={"p": "p - theta"}, sizes=(-5.0, 5.0), unit="kPa", signal="p")}
}


def several(fault: str, evident: str, at: float = 40.0) -> pl.DataFrame:
    """A diagnosis that names a fault that ``p`` or ``T`` can have, and says what ``p`` should read."""
    t = np.arange(0, 100, 0.5)
    on = (t >= at).astype(float)
    return pl.DataFrame(
        {
            "time": t,
            "detection": on.astype(np.int8),
            f"p.{fault}": on,
            **{f"sensor.{fault}.{s}": (30.0 if s == evident else 1.0) * on for s in ("p", "T")},
            "size.sensor_offset.p": np.full(t.size, 4.0),
            "size_sd.sensor_offset.p": np.full(t.size, 0.5),
            "expected.p": 100 + 10 * np.sin(t),
            "expected_sd.p": np.full(t.size, 0.3),
        }
    )


def test_an_offset_is_taken_off() -> None:
    group = accommodate(LOG, several("sensor_offset", "p"), "p", HYPOTHESES, OFFSET)
    assert group is not None
    raw, corrected, sd = (group.frame[c].to_numpy() for c in ("p", "p.corrected", "p.corrected_sd"))
    late = TIME >= 40
    np.testing.assert_array_equal(corrected[~late], raw[~late])
    np.testing.assert_allclose(corrected[late], raw[late] - 4.0)
    np.testing.assert_allclose(sd[late], 0.5)


def test_a_stuck_sensor_reads_what_the_others_say() -> None:
    group = accommodate(LOG, several("sensor_stuck", "p"), "p", HYPOTHESES, OFFSET)
    assert group is not None
    raw, corrected, sd = (group.frame[c].to_numpy() for c in ("p", "p.corrected", "p.corrected_sd"))
    late = TIME >= 40
    np.testing.assert_array_equal(corrected[~late], raw[~late])
    held = TIME[late] - np.floor(TIME[late] / 0.5 + 1e-9) * 0.5
    np.testing.assert_allclose(corrected[late], 100 + 10 * np.sin(TIME[late] - held))
    np.testing.assert_allclose(sd[late], 0.3)


def test_what_another_sensor_has_changes_nothing() -> None:
    group = accommodate(LOG, several("sensor_stuck", "T"), "p", HYPOTHESES, OFFSET)
    assert group is not None
    assert (group.frame["p"] == group.frame["p.corrected"]).all()
