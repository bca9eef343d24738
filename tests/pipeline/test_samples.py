from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipeline import samples
from pipeline.samples import Reader, Stored, evenly, writing


@pytest.fixture
def frame() -> pl.DataFrame:
    return pl.DataFrame({"time": [i / 2 for i in range(1000)], "z.a": [float(i % 7) for i in range(1000)]})


@pytest.fixture
def path(frame: pl.DataFrame, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Written in parts of odd sizes, 100 rows a group or a little more."""
    monkeypatch.setattr(samples, "BYTES", 1600)
    with writing(tmp_path / "x.parquet") as writer:
        for start in range(0, 1000, 37):
            writer.add(frame.slice(start, 37))
    return tmp_path / "x.parquet"


def test_what_is_read_is_what_was_written(frame: pl.DataFrame, path: Path) -> None:
    stored = Stored(path)
    assert stored.file.num_row_groups > 5
    assert (stored.columns, stored.height) == (frame.columns, 1000)
    for column in frame.columns:
        assert stored[column].equals(frame[column])


@pytest.mark.parametrize("offset", [0, 1, 99, 100, 111, 112, 500, 999, 1000])
@pytest.mark.parametrize("length", [0, 1, 12, 111, 400, 5000, None])
def test_slices(frame: pl.DataFrame, path: Path, offset: int, length: int | None) -> None:
    assert Stored(path).slice(offset, length).equals(frame.slice(offset, length))


def test_slices_of_columns_in_the_order_asked_for(frame: pl.DataFrame, path: Path) -> None:
    asked = Stored(path).select(["z.a", "time"])
    assert asked.columns == ["z.a", "time"]
    assert asked.slice(95, 30).equals(frame.select("z.a", "time").slice(95, 30))
    assert asked.select([]).slice(95, 30).width == 0


def test_rows_in_order_of_time_each_once(frame: pl.DataFrame, path: Path) -> None:
    reader = Reader(path)
    parts = [reader.before(t) for t in (0.0, 0.2, 10.0, 10.0, 333.3, float("inf"), float("inf"))]
    assert [p.height for p in parts[:4]] == [0, 1, 19, 0]
    assert parts[-1].height == 0
    assert pl.concat(parts).equals(frame)


def test_rows_are_taken_evenly_over_all_row_groups(tmp_path: Path) -> None:
    time = np.arange(1003.0)
    pl.DataFrame({"time": time, "v": 2 * time}).write_parquet(tmp_path / "s.parquet", row_group_size=70)
    taken = evenly(tmp_path / "s.parquet", 100)
    assert taken["time"].to_list() == time[::10].tolist()
    assert taken["v"].to_list() == (2 * time[::10]).tolist()
    assert evenly(tmp_path / "s.parquet", 5000).height == 1003
    pl.DataFrame({"time": time[:0]}).write_parquet(tmp_path / "none.parquet")
    assert evenly(tmp_path / "none.parquet").columns == ["time"]
