from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest

from ingest.blocks import rows
from ingest.log import Event, Group, Log, Signal
from ingest.mapping import apply_map
from ingest.maps import NameMap, SignalMap
from ingest.quality import Quality
from ingest.report import describe, quality, with_quality
from ingest.sampling import clock_quality


@pytest.fixture
def log() -> Log:
    time = np.arange(100) * 0.1
    time[50:] += 7.0
    time[20] = time[19]
    time[30], time[31] = time[31], time[30]
    frame = pl.DataFrame(
        {
            "time": time,
            "p_Bst": np.linspace(1.0, 2.0, 100),
            "slow": [float(i) if i % 10 == 0 else None for i in range(100)],
            "flat": [3.0] * 100,
            "gear": ["D"] * 100,
            "none": pl.Series([None] * 100, dtype=pl.Float64),
        }
    )
    signals = {"p_Bst": Signal(name="p_Bst", unit="bar"), "flat": Signal(name="flat", unit="wombat")}
    events = (Event(t_start=1.0, kind="maf_gain", source="truth"),)
    return apply_map(
        Log("x", {"g": Group("g", frame, signals)}, events, {"notes": ["n"], "seed": 1}), NameMap()
    )


def test_sampling(log: Log) -> None:
    found = quality(log)["p_Bst"]
    assert (found["rows"], found["rate_hz"], found["gaps"]) == (100, pytest.approx(10.0), 1)
    assert found["longest_gap"] == pytest.approx([4.9, 12.0])
    assert (found["duplicates"], found["out_of_order"]) == (1, 1)
    assert (found["min"], found["max"], found["unit"], found["source_unit"]) == (100.0, 200.0, "kPa", "bar")


def test_jitter_is_that_of_its_definition() -> None:
    steps = np.random.default_rng(0).uniform(0.08, 0.12, 20_000)  # percentiles 5, 50, 95: 0.082, 0.1, 0.118
    time = np.cumsum(steps)
    assert clock_quality(time)["jitter"] == pytest.approx(0.018 / 0.1, rel=0.02)
    assert clock_quality(np.arange(50) * 0.02)["jitter"] == pytest.approx(0.0, abs=1e-9)


def test_a_signal_with_empty_cells_has_its_own_rate(log: Log) -> None:
    slow = quality(log)["slow"]
    assert (slow["rows"], slow["missing"], slow["missing_share"]) == (10, 90, 0.9)
    assert slow["rate_hz"] == pytest.approx(1.0)


def test_constant_missing_and_units(log: Log) -> None:
    found = quality(log)
    assert [n for n, s in found.items() if s["constant"]] == ["flat", "gear"]
    assert (found["none"]["rows"], found["none"]["rate_hz"], found["none"]["min"]) == (0, None, None)
    assert found["flat"]["flags"] == ["unit unknown"]
    assert [s["unit_from"] for s in found.values()] == ["file", "none", "file", "none", "none"]
    names = NameMap(
        signals={"p_Int": SignalMap(source=("slow",), unit="Pa"), "p_Amb": SignalMap(source=("flat",))}
    )
    bare = Log("y", {"g": Group("g", log.groups["g"].frame.select("time", "slow", "flat"))})
    assert [s["unit_from"] for s in quality(apply_map(bare, names)).values()] == ["map", "assumed"]


def test_description_is_plain_json(log: Log) -> None:
    found = describe(log)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["span_s"] == [0.0, pytest.approx(16.9)]
    assert found["groups"]["g"]["signals"] == list(log.signals)
    assert found["events"][0]["kind"] == "maf_gain"
    assert (found["notes"], found["salvaged"], found["facts"]) == (["n"], [], {"seed": 1})


def test_description_of_a_header() -> None:
    empty = pl.DataFrame(schema={"time": pl.Float64, "a": pl.Float64})
    found = describe(Log("x", {"g": Group("g", empty)}, (), {"rows": {"g": 7}}))
    assert found["span_s"] is None
    assert (found["groups"]["g"]["rows"], found["signals"]["a"]["missing_share"]) == (7, None)


def drive(rows: int = 2000, seed: int = 0) -> dict[str, np.ndarray]:
    """A signal with noise, as a sensor has it, sampled at 10 Hz."""
    noise = np.random.default_rng(seed).normal(0.0, 0.1, rows)
    return {"time": np.arange(rows) * 0.1, "x": 50.0 + 10 * np.sin(np.arange(rows) * 0.01) + noise}


def found_in(
    columns: dict[str, np.ndarray],
) -> tuple[dict[str, object], list[object]]:
    log = Log("x", {"g": Group("g", pl.DataFrame(columns))})
    events: list[object] = [(e.kind, e.t_start, e.t_end) for e in with_quality(log).events]
    return {k: quality(log)["x"][k] for k in ("stuck", "clipped", "spikes", "clock_jumps")}, events


def test_a_healthy_signal_has_no_remarks() -> None:
    for seed in range(20):
        found, events = found_in(drive(seed=seed))
        assert (set(found.values()), events) == ({0}, [])


def test_a_stuck_sensor() -> None:
    columns = drive()
    columns["x"][500:600] = columns["x"][500]
    found, events = found_in(columns)
    assert found == {"stuck": 1, "clipped": 0, "spikes": 0, "clock_jumps": 0}
    assert events == [("stuck", pytest.approx(50.0), pytest.approx(59.9))]


def test_clipping_at_the_end_of_a_range_but_not_rest_at_0() -> None:
    columns = drive()
    columns["x"] = np.minimum(columns["x"], 58.0)
    found, events = found_in(columns)
    assert found["clipped"] == pytest.approx((columns["x"] == 58.0).sum(), rel=0.05)
    assert events
    assert all("clipping" in str(e) for e in events)
    columns["x"] = np.maximum(drive()["x"] - 45.0, 0.0)
    assert found_in(columns)[0]["clipped"] == 0


def test_spikes() -> None:
    columns = drive()
    columns["x"][[300, 700]] += [40.0, -30.0]
    found, events = found_in(columns)
    assert found["spikes"] == 2
    assert events == [
        ("spike", pytest.approx(30.0), pytest.approx(30.0)),
        ("spike", pytest.approx(70.0), pytest.approx(70.0)),
    ]


def test_a_clock_that_jumps_back() -> None:
    columns = drive()
    columns["time"][1000:] -= 60.0
    found, events = found_in(columns)
    assert found["clock_jumps"] == 1
    assert events == [("clock jump", pytest.approx(40.0), pytest.approx(99.9))]


def test_signals_that_move_in_steps_are_not_stuck() -> None:
    columns = drive()
    columns["x"] = np.round(columns["x"] / 5) * 5
    assert set(found_in(columns)[0].values()) == {0}


@pytest.mark.parametrize("size", [1, 2, 3, 7, 100, 1999])
def test_parts_are_judged_as_the_whole(size: int) -> None:
    columns = drive()
    columns["x"][500:600] = columns["x"][500]
    columns["x"][[0, 1, 300, 1998]] += 40.0
    columns["x"] = np.minimum(columns["x"], 75.0)
    frame = pl.DataFrame(columns).with_columns(
        y=pl.when(pl.int_range(2000) % 3 == 0).then(pl.col("x")), word=pl.lit("a"), n=pl.int_range(2000)
    )
    log = Log("x", {"g": Group("g", frame)})
    parts = Quality()
    for part in rows(log, size):
        parts.add(part)
    assert describe(log, parts) == describe(log)


def test_events_of_an_earlier_report_are_replaced(log: Log) -> None:
    once = with_quality(log)
    assert [e.kind for e in once.events] == ["maf_gain", "clock jump"] or len(once.events) > 1
    assert with_quality(once).events == once.events
