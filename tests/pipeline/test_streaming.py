"""A log that is diagnosed in parts says what it says as a whole."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ingest import read_log, write_log
from ingest.blocks import in_step, join, rows
from ingest.errors import LogError
from ingest.log import Group, Log
from ingest.recording import recording
from pipeline import run
from pipeline.batch import Options
from pipeline.detector import Detector

PLAIN = Options(timeline=False)


def in_parts_of(log: Log, size: int, path: Path) -> Path:
    """The log as a file whose parts have ``size`` rows."""
    with recording(path, log) as recorder:
        for part in rows(log, size):
            recorder.add(part)
        recorder.finish(log, {})
    return path


def assert_same(one: pl.DataFrame, other: pl.DataFrame) -> None:
    """Equal but for the last digits, which the linear algebra's own blocking may change."""
    assert one.schema == other.schema
    for c, dtype in one.schema.items():
        x, y = (f[c].cast(pl.Float64).fill_null(np.nan).to_numpy() for f in (one, other))
        np.testing.assert_allclose(x, y, rtol=1e-4 if dtype == pl.Float32 else 1e-7, atol=1e-6, err_msg=c)


@pytest.mark.parametrize(
    ("suffix", "size"), [(".parquet", 700), (".parquet", 10**6), (".mcap", 5000), (".csv", 5000)]
)
def test_the_result_does_not_depend_on_the_parts(
    faulty: Log, detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    suffix: str, size: int,
) -> None:  # fmt: skip
    path = in_parts_of(faulty, size, tmp_path / f"faulty{suffix}")
    (expected,) = run([path], detector, tmp_path / "whole", PLAIN).to_dicts()
    monkeypatch.setattr("pipeline.task.WHOLE_BYTES", 0)
    monkeypatch.setattr("ingest.readers.mcap.BLOCK_BYTES", 100 * size)
    (row,) = run([path], detector, tmp_path / "out", Options(timeline=True)).to_dicts()
    exact = {k: v for k, v in expected.items() if not isinstance(v, float)}
    assert {k: row[k] for k in exact} == exact
    assert row == pytest.approx(expected)
    out, one = tmp_path / "out" / "faulty", tmp_path / "whole" / "faulty"
    assert_same(pl.read_parquet(out / "samples.parquet"), pl.read_parquet(one / "samples.parquet"))
    signals, known_signals = (pl.read_parquet(f / "signals.parquet") for f in (out, one))
    assert signals["W_HFM"].equals(known_signals["W_HFM"])
    ratio = (signals["W_HFM.corrected"] / known_signals["W_HFM.corrected"]).to_numpy()
    assert (np.abs(ratio - 1) > 1e-3).sum() <= signals.height // size + 1  # at most at the ends of parts
    verdict, judged = (json.loads((f / "verdict.json").read_text()) for f in (out, one))
    assert verdict["quality"].keys() == judged["quality"].keys()
    for name in ("W_HFM", "p_Int"):
        for about in ("rows", "rate_hz", "gaps", "missing", "min", "max"):
            assert verdict["quality"][name][about] == judged["quality"][name][about]
    annotated, known = read_log(out / "annotated.mcap"), read_log(one / "annotated.mcap")
    assert list(annotated.groups) == list(known.groups)
    for name, group in known.groups.items():
        assert annotated.groups[name].frame.columns == group.frame.columns
        assert annotated.groups[name].frame.height == group.frame.height
    assert all(
        annotated.groups[g].frame.equals(known.groups[g].frame) for g in faulty.groups if g in known.groups
    )
    assert [e.kind for e in annotated.events] == [e.kind for e in known.events]
    assert json.loads((out / "manifest.json").read_text())["in_parts"] is True
    before = out.stat().st_ino
    run([path], detector, tmp_path / "out", Options(timeline=True))
    assert out.stat().st_ino == before  # done


def two_rates(rows_of_a: int = 100) -> Log:
    fast = pl.DataFrame({"time": np.arange(rows_of_a) / 100, "a": np.arange(rows_of_a)})
    slow = pl.DataFrame({"time": np.arange(10) / 10, "b": np.arange(10)})
    return Log("x", {"fast": Group("fast", fast), "slow": Group("slow", slow)}, (), {"k": 1})


@pytest.mark.parametrize("size", [1, 7, 10, 1000])
@pytest.mark.parametrize("known", [True, False])
def test_groups_are_brought_in_step(size: int, known: bool) -> None:
    log = two_rates()
    counts = {k: g.frame.height for k, g in log.groups.items()} if known else None
    parts = list(in_step(rows(log, size), counts))
    assert join(parts).equals(log)
    ends = [
        (max((g.time[-1] for g in a.groups.values() if g.frame.height), default=-1.0),
         min((g.time[0] for g in b.groups.values() if g.frame.height), default=9.0))
        for a, b in pairwise(parts)
    ]  # fmt: skip
    assert all(end < begin for end, begin in ends)


def test_a_group_that_has_ended_holds_nobody_up() -> None:
    log = two_rates(1000)  # 10 s, the other group ends after 1 s
    counts = {k: g.frame.height for k, g in log.groups.items()}
    heights = [p.groups["fast"].frame.height for p in in_step(rows(log, 100), counts)]
    assert max(heights) <= 200
    assert sum(heights) == 1000


def test_a_clock_that_begins_again_is_an_error_not_a_wrong_answer() -> None:
    log = two_rates()
    frame = pl.concat([log.groups["fast"].frame, log.groups["fast"].frame])
    twice = replace(log, groups={"fast": replace(log.groups["fast"], frame=frame)})
    with pytest.raises(LogError, match=r"clock of group 'fast' goes back from .* split it"):
        list(in_step(rows(twice, 60)))


def test_a_foreign_file_with_dates_is_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ingest.readers.parquet.BLOCK_BYTES", 8 * 2 * 10)
    stamps = pl.datetime_range(pl.datetime(2026, 1, 1), pl.datetime(2026, 1, 1, 0, 0, 59), "1s", eager=True)
    path = tmp_path / "x.parquet"
    pl.DataFrame({"time": stamps, "a": range(60)}).write_parquet(path)
    from ingest.files import read_blocks

    parts = list(read_blocks(path))
    assert len(parts) == 6
    assert join(parts).groups["data"].frame.equals(read_log(path).groups["data"].frame)


def test_a_log_without_samples(detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.task.WHOLE_BYTES", 0)
    (tmp_path / "empty.csv").write_text("time,p_Int\n")
    write_log(two_rates(), tmp_path / "other.parquet")
    summary = run([tmp_path / "empty.csv", tmp_path / "other.parquet"], detector, tmp_path / "out", PLAIN)
    assert summary["status"].to_list() == ["failed", "failed"]
    assert "has no signal 'p_Int'" in summary["reason"][1]
    assert not [p for p in (tmp_path / "out").iterdir() if p.is_dir()]


def test_a_log_in_parts_has_its_timeline(
    faulty: Log, detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its signals keep their peaks, its residuals are those of the samples, and the map has its points."""
    from rerun.chunk import RrdReader

    monkeypatch.setattr("pipeline.task.WHOLE_BYTES", 0)
    monkeypatch.setattr("pipeline.samples.DRAWN", 300)
    monkeypatch.setattr("viz.reduce.ENVELOPE_POINTS", 2000)
    path = in_parts_of(faulty, 3000, tmp_path / "faulty.parquet")
    run([path], detector, tmp_path / "out", Options(timeline=True))
    folder = tmp_path / "out" / "faulty"
    drawn: dict[str, list[list[Any]]] = {}
    entities = set()
    for chunk in RrdReader(folder / "timeline.rrd").stream():
        batch = chunk.to_record_batch()
        name = str(chunk.entity_path).replace("\\", "")
        entities.add(name)
        for component in ("Scalars:scalars", "signals:values"):
            if not chunk.is_static and component in batch.schema.names:
                drawn.setdefault(name, []).extend(batch[component].to_pylist())
    for name in ("p_Bst", "p_Int"):
        pressure = np.array([row[0][name] for row in drawn["/signals/ecu"]])
        assert len(pressure) < 2600
        values = faulty.values(name)
        assert (np.nanmin(pressure), np.nanmax(pressure)) == (values.min(), values.max())
    samples = pl.read_parquet(folder / "samples.parquet")
    residual = np.array(drawn["/residuals/r_cyl/value"]).ravel()
    assert 250 < residual.size < 320
    assert set(residual[np.isfinite(residual)]) <= set(samples["residual.r_cyl"].to_list())
    assert {"/map/now", "/model", "/alarm", "/cdf/lines", "/sensor/readings", "/sensor/errors"} <= entities
    kept = pl.read_parquet(folder / "signals.parquet")
    raw, mended = np.array([v for v in drawn["/sensor/readings"] if np.isfinite(v).all()]).T
    assert 250 < raw.size < 700
    assert set(raw) <= set(kept["W_HFM"].to_list())
    assert set(mended) <= set(kept["W_HFM.corrected"].to_list())
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["shown"]["about"]["models"]


def test_thinned_samples_keep_every_change_of_the_alarm(tmp_path: Path) -> None:
    from pipeline.samples import thinned

    detection = np.zeros(100_000, dtype=np.int8)
    detection[70_003:70_009] = 1
    frame = pl.DataFrame({"time": np.arange(100_000.0), "detection": detection})
    frame.write_parquet(tmp_path / "s.parquet")
    some, rows = thinned(tmp_path / "s.parquet", 100)
    assert some["time"].to_list() == rows.tolist()
    assert {0, 1000, 70_003, 70_009} <= set(rows.tolist())
    assert len(rows) < 110
    assert thinned(tmp_path / "s.parquet", 10**6)[0].equals(frame)
