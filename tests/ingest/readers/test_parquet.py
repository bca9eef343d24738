from __future__ import annotations

import datetime as dt
from pathlib import Path

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ingest import read_log, write_log
from ingest.errors import LogError
from ingest.files import read_header
from ingest.log import Group, Log, Signal
from ingest.maps import NameMap, TimeMap


@pytest.fixture
def log() -> Log:
    ecu = pl.DataFrame({"time": [0.0, 0.1, 0.2], "p_Bst": [100.0, 101.5, None]})
    slow = pl.DataFrame({"time": [0.0, 1.0], "gear": [1, 2], "mode": ["a", None]})
    signal = Signal(name="p_Bst", unit="kPa", source_name="pic")
    return Log(
        "x", {"ecu": Group("ecu", ecu, {"p_Bst": signal}), "slow": Group("slow", slow)}, (), {"seed": 1}
    )


def test_other_tools_see_one_table_with_units(tmp_path: Path, log: Log) -> None:
    path = write_log(log, tmp_path / "x.parquet")
    table = pl.read_parquet(path)
    assert table.columns == ["time", "p_Bst", "gear", "mode"]
    seen = table.select("time", "gear").drop_nulls()
    assert seen.equals(log.groups["slow"].frame.select("time", "gear"))
    metadata = pq.read_schema(path).field("p_Bst").metadata
    assert metadata == {b"unit": b"kPa", b"source_name": b"pic"}


def test_files_of_others(tmp_path: Path) -> None:
    start = dt.datetime(2024, 5, 1, 12, 0, 0)
    table = pa.table(
        {
            "stamp": [start + dt.timedelta(milliseconds=100 * i) for i in (1, 0, 2)] + [None],
            "p_Bst": pa.array([1.0, 2.0, 3.0, 4.0], pa.float32()),
            "mode": pa.array(["a", "b", "a", "a"]).dictionary_encode(),
            "spectrum": [[1], [2], [3], [4]],
        }
    )
    schema = table.schema.set(1, table.schema.field(1).with_metadata({"unit": "bar"}))
    pq.write_table(table.cast(schema), tmp_path / "y.parquet")
    log = read_log(tmp_path / "y.parquet", NameMap(time=TimeMap(source=("stamp",))))
    assert log.name == "y"
    assert log.groups["data"].frame.rows() == [(0.1, 100.0, "a"), (0.0, 200.0, "b"), (0.2, 300.0, "a")]
    assert log.groups["data"].frame.schema["p_Bst"] == pl.Float32
    assert log.facts["start_time"] == start.isoformat()
    assert "1 rows without a time" in log.facts["notes"][0]
    assert "'spectrum' was skipped" in log.facts["notes"][1]
    head = read_header(tmp_path / "y.parquet", NameMap(time=TimeMap(source=("stamp",))))
    assert head.facts["rows"] == {"data": 4}
    with pytest.raises(LogError, match=r"no time column.*\[time\] source"):
        read_log(tmp_path / "y.parquet")


def test_a_wrong_byte_is_never_wrong_data(tmp_path: Path, log: Log) -> None:
    path = write_log(log, tmp_path / "x.parquet")
    good = path.read_bytes()
    bad = tmp_path / "bad.parquet"
    refused = 0
    for at in range(4, len(good), 2):
        bad.write_bytes(good[:at] + bytes([good[at] ^ 0x5A]) + good[at + 1 :])
        try:
            back = read_log(bad)
        except LogError:
            refused += 1
        else:
            if not back.equals(log):  # our description was not recognised: a table of someone's, same numbers
                assert list(back.groups) == ["data"], f"byte {at}"
                table = back.groups["data"].frame
                for group in log.groups.values():
                    for name in group.signals:
                        pair = group.frame.select("time", name).drop_nulls()
                        assert table.select("time", name).drop_nulls().equals(pair), f"byte {at}"
    assert refused > 10


def test_cut_files_are_refused(tmp_path: Path, log: Log) -> None:
    good = write_log(log, tmp_path / "x.parquet").read_bytes()
    for end in (5, len(good) // 2, len(good) - 3):
        (tmp_path / "bad.parquet").write_bytes(good[:end])
        with pytest.raises(LogError, match="damaged Parquet file"):
            read_log(tmp_path / "bad.parquet")
