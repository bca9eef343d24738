"""The engine data set of Bosch: no names, no time; where it is at hand (it may not be redistributed)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ingest import read_log
from ingest.files import read_header
from ingest.maps import NameMap, TimeMap
from pipeline.cli import main

PATH = Path(__file__).parents[2].parent / "shared" / "data" / "bosch" / "gengine1_000010.csv"
pytestmark = pytest.mark.skipif(not PATH.is_file(), reason="the Bosch engine data are not at hand")


def test_values_are_those_of_the_file_at_the_rate_of_the_map() -> None:
    raw = np.loadtxt(PATH, delimiter=",")
    log = read_log(PATH, NameMap(time=TimeMap(rate=10.0)))
    frame = log.groups["data"].frame
    assert frame.columns == ["time", *(f"c{i:02d}" for i in range(1, 14))]
    np.testing.assert_array_equal(frame.drop("time").to_numpy(), raw)
    np.testing.assert_array_equal(frame["time"], np.arange(len(raw)) / 10)
    assert list(read_header(PATH).signals) == frame.columns[1:]


def test_ingest_without_a_map_says_what_it_assumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ingest", str(PATH), "--out", str(tmp_path)]) == 0
    assert "rows are counted as 1 s each" in capsys.readouterr().out
    assert read_log(tmp_path / f"{PATH.stem}.mcap").groups["data"].rate_hz == 1.0
