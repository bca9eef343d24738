from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest

from ingest.log import Event, Group, Log, Signal
from ingest.maps import NameMap, SignalMap, apply_map
from ingest.report import clock_quality, describe, quality


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
    time = np.zeros(len(steps))
    np.cumsum(steps, out=time)
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
