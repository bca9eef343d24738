from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from ingest import read_log
from ingest.errors import LogError
from ingest.files import read_header

VALUES = np.random.default_rng(0).normal(size=1000)
SCHEMA = pa.schema(
    [pa.field("time", pa.timestamp("ms")), pa.field("p_Bst", pa.float64(), metadata={"unit": "bar"})]
)


def write(path: Path, *, stream: bool) -> Path:
    start = dt.datetime(2024, 5, 1, 12)
    stamps = [start + dt.timedelta(milliseconds=100 * i) for i in range(1000)]
    table = pa.table({"time": stamps, "p_Bst": VALUES}).cast(SCHEMA)
    with (pa.ipc.new_stream if stream else pa.ipc.new_file)(path, SCHEMA) as writer:
        writer.write_table(table, max_chunksize=100)
    return path


@pytest.mark.parametrize("stream", [True, False])
def test_files_and_streams(tmp_path: Path, stream: bool) -> None:
    path = write(tmp_path / "x.arrow", stream=stream)
    log = read_log(path)
    np.testing.assert_allclose(log.values("p_Bst"), VALUES * 100.0)
    np.testing.assert_allclose(log.groups["data"].time, np.arange(1000) / 10)
    assert log.facts["start_time"] == "2024-05-01T12:00:00"
    assert "salvaged" not in log.facts
    assert list(read_header(path).signals) == ["p_Bst"]


@pytest.mark.parametrize("stream", [True, False])
def test_whole_batches_of_a_cut_file(tmp_path: Path, stream: bool) -> None:
    path = write(tmp_path / "x.arrow", stream=stream)
    good = path.read_bytes()
    for part in range(4, 20):
        path.write_bytes(good[: len(good) * part // 20])
        log = read_log(path)
        got = log.values("p_Bst")
        assert len(got) % 100 == 0
        np.testing.assert_allclose(got, VALUES[: len(got)] * 100.0)
        assert log.facts["salvaged"]


def test_damaged(tmp_path: Path) -> None:
    path = tmp_path / "x.arrow"
    for content in (b"ARROW1\0\0", b"\xff\xff\xff\xff" + bytes(8), b"ARROW1" + b"\xff" * 50):
        path.write_bytes(content)
        with pytest.raises(LogError, match=r"x\.arrow: (damaged Arrow file|no )"):
            read_log(path)
