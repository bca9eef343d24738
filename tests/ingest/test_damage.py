"""Whatever is in a file, it is read, or refused in a word that names it: never a traceback."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from ingest import read_log, write_log
from ingest.errors import DynoscopeError, LogError
from ingest.files import read_header
from ingest.log import Group, Log

MAGIC = [
    b"", b"\x89MCAP0\r\n", b"PAR1", b"ARROW1\0\0", b"\xff\xff\xff\xff", b"MDF     4.10    ", b"TDSm",
    b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file", b"\x89HDF\r\n\x1a\n", b"LOGG", b"date x\nbase hex",
    b"time,a\n", b"\xff\xfe", b"\xef\xbb\xbf", b"# dynoscope ",
]  # fmt: skip


@settings(max_examples=80, deadline=None, derandomize=True)
@given(magic=st.sampled_from(MAGIC), body=st.binary(max_size=400), text=st.text(max_size=200))
def test_any_bytes(magic: bytes, body: bytes, text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "some.log"
        for content in (magic + body, magic + text.encode()):
            path.write_bytes(content)
            for read in (read_log, read_header):
                try:
                    read(path)
                except DynoscopeError as error:
                    assert "some.log" in str(error)  # noqa: PT017 - most bytes are no log, some are


def test_empty_and_unreadable(tmp_path: Path) -> None:
    path = tmp_path / "x.mf4"
    path.write_bytes(b"")
    with pytest.raises(LogError, match=r"x\.mf4: the file is empty"):
        read_log(path)
    path.write_bytes(b"\x00\x01\x02\x03")
    with pytest.raises(LogError, match=r"x\.mf4: not a log of a known format"):
        read_log(path)


def test_a_wide_table(tmp_path: Path) -> None:
    """Names of more than a mebibyte."""
    width = 200
    names = [f"a_channel_{i}_with_a_rather_long_name".ljust(6000, "_") for i in range(width)]
    row = ",".join(["1.5"] * width)
    path = tmp_path / "wide.csv"
    path.write_text("time," + ",".join(names) + f"\n0,{row}\n1,{row}\n")
    assert path.read_text().index("\n") > 1 << 20
    log = read_log(path)
    assert len(log.signals) == width
    assert log.values(names[-1]).tolist() == [1.5, 1.5]


def test_a_table_that_claims_a_trillion_rows(tmp_path: Path) -> None:
    """A few kilobytes that unpack to more than any memory holds."""
    rows = 1 << 20
    path = tmp_path / "x.parquet"
    column = pa.array(np.zeros(rows, np.float32))
    batch = pa.table({"time": column} | {f"c{i}": column for i in range(50)})
    with pq.ParquetWriter(path, batch.schema, compression="zstd") as writer:
        for _ in range(2):
            writer.write_table(batch)
    assert path.stat().st_size < 1_000_000
    assert len(read_header(path).signals) == 50
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.sysconf", lambda name: 1 << 12)  # a machine of 16 MiB
        with pytest.raises(LogError, match=r"declares 2097152 rows of 51 channels.*the file is damaged"):
            read_log(path)


def test_names_that_lead_elsewhere(tmp_path: Path) -> None:
    log = Log("../../x", {"../g": Group("../g", pl.DataFrame({"time": [0.0], "../a": [1.0]}))})
    for suffix in (".mcap", ".parquet", ".csv"):
        assert read_log(write_log(log, tmp_path / "in" / f"x{suffix}")).values("../a").tolist() == [1.0]
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


def test_json_rows_with_nan(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for i, value in enumerate((1.0, float("nan"), None)):
            writer.add_message(channel, i, json.dumps({"x": value}).encode(), i)
        writer.add_message(channel, 3, b"{broken", 3)
        writer.finish()  # type: ignore[no-untyped-call]
    log = read_log(path)
    assert log.groups["a"].frame["x"].to_list() == [1.0, None, None]
    assert "1 messages of channel /a are lost" in log.facts["salvaged"][0]


def test_milliseconds_without_a_unit_are_asked_about(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("time,a\n" + "".join(f"{i * 10},{i}\n" for i in range(20)))
    (note,) = read_log(path).facts["notes"]
    assert 'taken as s, 10 s from row to row; if not so, a map says so: [time] unit = "ms"' in note
