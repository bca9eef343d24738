"""What is written comes back: random logs through each format that we write."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ingest import read_log, write_log
from ingest.errors import LogError
from ingest.files import read_header
from ingest.log import Event, Group, Log, Signal

INTEGERS = (pl.Int8, pl.Int16, pl.Int32, pl.Int64, pl.UInt8, pl.UInt16, pl.UInt32, pl.UInt64)
NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=12)
TEXT = st.text(max_size=8)
TIMES = st.floats(-1e6, 1e9)


def values_of(dtype: Any) -> st.SearchStrategy[Any]:
    if dtype == pl.Boolean:
        return st.booleans()
    if dtype == pl.String:
        return TEXT
    if dtype in (pl.Float32, pl.Float64):
        return st.floats(width=32 if dtype == pl.Float32 else 64, allow_nan=True)
    low, high = pl.select(dtype.min().alias("a"), dtype.max().alias("b")).row(0)
    return st.integers(low, high) | st.integers(-5 if low else 0, 5)


@st.composite
def signals(draw: st.DrawFn, name: str) -> Signal:
    number = st.floats(-1e9, 1e9)
    return Signal(
        name=name,
        unit=draw(st.none() | TEXT),
        kind=draw(st.sampled_from(["continuous", "state", "counter"])),
        resample=draw(st.sampled_from(["linear", "hold", "none"])),
        source_name=draw(st.none() | TEXT),
        source_unit=draw(st.none() | TEXT),
        scale=draw(number),
        offset=draw(number),
        description=draw(TEXT),
        flags=tuple(draw(st.lists(TEXT, max_size=2))),
    )


@st.composite
def logs(draw: st.DrawFn) -> Log:
    names = draw(st.lists(NAMES.filter(lambda n: n != "time"), unique=True, max_size=6))
    keys = draw(st.lists(NAMES, unique=True, min_size=1, max_size=3))
    homes = {k: [n for i, n in enumerate(names) if i % len(keys) == j] for j, k in enumerate(keys)}
    groups = {}
    for key, members in homes.items():
        rows = draw(st.integers(0, 6))
        columns = [pl.Series("time", draw(st.lists(TIMES, min_size=rows, max_size=rows)), dtype=pl.Float64)]
        for name in members:
            dtype = draw(st.sampled_from([pl.Float32, pl.Float64, pl.Boolean, pl.String, *INTEGERS]))
            cells = st.none() | values_of(dtype)
            values = draw(st.lists(cells, min_size=rows, max_size=rows))
            columns.append(pl.Series(name, values, dtype=dtype))
        groups[key] = Group(key, pl.DataFrame(columns), {n: draw(signals(n)) for n in members})
    some, size = st.none() | TEXT, st.none() | st.floats(-1, 1)
    event = st.builds(
        Event, t_start=TIMES, t_end=st.none() | TIMES, kind=TEXT, source=TEXT, channel=some, magnitude=size
    )
    events = draw(st.lists(event, max_size=3))
    json = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT,
        lambda inner: st.lists(inner, max_size=2) | st.dictionaries(TEXT, inner, max_size=2),
        max_leaves=4,
    )
    facts = draw(st.dictionaries(TEXT, json, max_size=3))
    return Log(draw(TEXT), groups, tuple(events), facts)


def same_bits(a: Log, b: Log) -> bool:
    """Also the sign of zero, which ``equals`` does not see."""
    return all(
        np.array_equal(*(np.signbit(log.groups[k].frame[c].to_numpy()) for log in (a, b)))
        for k, g in a.groups.items()
        for c, t in g.frame.schema.items()
        if t.is_float() and not g.frame[c].null_count()
    )


@pytest.mark.parametrize("suffix", ["mcap", "parquet"])
@settings(max_examples=80, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(log=logs())
def test_lossless(suffix: str, log: Log) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x.{suffix}"
        write_log(log, path)
        back = read_log(path)
        assert back.equals(log)
        assert same_bits(log, back)
        head = read_header(path)
        assert head.signals == log.signals
        assert {k: g.frame.schema for k, g in head.groups.items()} == {
            k: g.frame.schema for k, g in log.groups.items()
        }
        assert head.facts["rows"] == {k: g.frame.height for k, g in log.groups.items()}
        assert all(not g.frame.height for g in head.groups.values())


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    slow=st.lists(st.floats(-1e300, 1e300), min_size=1, max_size=5),
    fast=st.lists(st.none() | st.floats(width=64, allow_nan=False), min_size=3, max_size=8),
)
def test_csv_keeps_numbers_events_and_groups(slow: list[float], fast: list[float | None]) -> None:
    groups = {
        "slow": Group("slow", pl.DataFrame({"time": [i * 1.0 for i in range(len(slow))], "a": slow})),
        "fast": Group(
            "fast",
            pl.DataFrame({"time": [i * 0.1 for i in range(len(fast))], "b": pl.Series(fast, dtype=pl.Float64),
                          "state": ["x"] * len(fast)}),
            {"b": Signal(name="b", unit="V"), "state": Signal(name="state", kind="state", resample="hold")},
        ),
    }  # fmt: skip
    log = Log("x", groups, (Event(t_start=1.0, kind="maf_gain", source="truth"),), {"seed": 3})
    with tempfile.TemporaryDirectory() as folder:
        back = read_log(write_log(log, Path(folder) / "y.csv"))
    assert {"file", "format", "sha256"} <= set(back.facts)
    assert (back.name, back.events, back.facts["seed"]) == ("x", log.events, 3)
    assert back.signals == log.signals
    assert back.groups["slow"].frame.equals(groups["slow"].frame)
    assert back.groups["fast"].frame.equals(groups["fast"].frame)


def test_csv_with_repeated_stamps_and_truth_values(tmp_path: Path) -> None:
    frame = pl.DataFrame({"time": [0.0, 1.0, 1.0, 2.0], "repeat": [1.0, 2.0, 3.0, 4.0]})
    flags = pl.DataFrame({"time": [1.0, 3.0], "on": [True, False]})
    log = Log("x", {"a": Group("a", frame), "b": Group("b", flags)})
    back = read_log(write_log(log, tmp_path / "x.csv"))
    assert back.groups["a"].frame.equals(frame)
    assert back.groups["b"].frame.rows() == [(1.0, 1.0), (3.0, 0.0)]


def test_many_rows_over_many_chunks(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = 50_000
    time = rng.permutation(rows) / 100.0  # order of the source, not of time
    frame = pl.DataFrame({"time": time} | {f"s{i}": rng.normal(size=rows) for i in range(20)})
    text = pl.DataFrame({"time": time, "word": [f"{v:.3f} " * 3 for v in time]})
    log = Log("big", {"f": Group("f", frame), "t": Group("t", text)})
    for suffix in ("mcap", "parquet"):
        assert read_log(write_log(log, tmp_path / f"x.{suffix}")).equals(log)


@pytest.mark.parametrize("suffix", ["mcap", "parquet", "csv"])
def test_what_no_format_holds_is_refused(tmp_path: Path, suffix: str) -> None:
    frame = pl.DataFrame({"time": [0.0], "a": [[1, 2]]})
    with pytest.raises(LogError, match=r"'a'.*List.*numbers"):
        write_log(Log("x", {"g": Group("g", frame)}), tmp_path / f"x.{suffix}")
    plain = Group("g", pl.DataFrame({"time": [0.0]}))
    with pytest.raises(LogError, match="facts cannot be written"):
        write_log(Log("x", {"g": plain}, (), {"path": tmp_path}), tmp_path / f"x.{suffix}")
    zero = Group("g", pl.DataFrame({"time": [0.0], "a\0": [1.0]}))
    with pytest.raises(LogError, match="zero character"):
        write_log(Log("x", {"g": zero}), tmp_path / f"x.{suffix}")
    assert not list(tmp_path.iterdir())


def test_time_that_no_log_time_holds(tmp_path: Path) -> None:
    log = Log("x", {"g": Group("g", pl.DataFrame({"time": [1.7e18]}))})
    with pytest.raises(LogError, match=r"time stamps reach 1\.7e\+18 s"):
        write_log(log, tmp_path / "x.mcap")
