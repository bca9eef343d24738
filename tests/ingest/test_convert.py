from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader

from ingest import read_log, write_log
from ingest.blocks import join, rows
from ingest.continued import read_continued
from ingest.convert import convert
from ingest.errors import LogError
from ingest.files import read_blocks
from ingest.log import Event, Group, Log, Signal
from ingest.report import describe


def make_log(groups: int = 2) -> Log:
    rng = np.random.default_rng(0)
    fast = pl.DataFrame(
        {
            "time": np.arange(5000) * 0.01,
            "p_Bst": 100 + rng.normal(size=5000),
            "mode": ["a", None, "bü"] * 1666 + ["a"] * 2,
        }
    )
    slow = pl.DataFrame({"time": np.arange(500) * 0.1, "n": pl.Series(range(500), dtype=pl.Int64)})
    slow = slow.with_columns(pl.when(pl.col("n") != 7).then(pl.col("n") + (1 << 60)).alias("n"))
    both = {"ecu": Group("ecu", fast, {"p_Bst": Signal(name="p_Bst", unit="kPa", flags=("unit assumed",))}),
            "a/../b": Group("a/../b", slow)}  # fmt: skip
    events = (
        Event(t_start=9.0, kind="maf_gain", source="truth"),
        Event(t_start=1.0, kind="x", source="truth"),
    )
    return Log("drive", dict(list(both.items())[:groups]), events, {"seed": 1})


@pytest.mark.parametrize("size", [7, 1000, 10_000])
def test_parts_give_the_same_files_as_the_whole(tmp_path: Path, size: int) -> None:
    log = make_log()
    report, files = convert(rows(log, size), tmp_path, "x", {"map.toml": b"# none"})
    assert sorted(str(f.relative_to(tmp_path)) for f in files) == [
        "x.mcap", "x/a%2F..%2Fb.parquet", "x/ecu.parquet", "x/report.json",
    ]  # fmt: skip
    back = read_log(tmp_path / "x.mcap")
    assert [e for e in back.events if e.source == "truth"] == list(log.events)
    for key, group in log.groups.items():
        assert back.groups[key].frame.equals(group.frame)
        assert dict(back.groups[key].signals) == dict(group.signals)
    parquet = read_log(tmp_path / "x" / "ecu.parquet")
    assert parquet.groups["ecu"].frame.equals(log.groups["ecu"].frame)
    assert parquet.events == back.events
    assert report == describe(log) == json.loads((tmp_path / "x" / "report.json").read_text())
    with (tmp_path / "x.mcap").open("rb") as stream:
        attached = {a.name: a.data for a in make_reader(stream, validate_crcs=True).iter_attachments()}
    assert attached["map.toml"] == b"# none"
    assert json.loads(attached["report.json"]) == report


def test_group_files_of_an_earlier_conversion_go_and_others_stay(tmp_path: Path) -> None:
    convert([make_log()], tmp_path, "x")
    (tmp_path / "x" / "mine.parquet").write_bytes(b"")
    convert([make_log(groups=1)], tmp_path, "x")
    assert sorted(p.name for p in (tmp_path / "x").iterdir()) == [
        "ecu.parquet",
        "mine.parquet",
        "report.json",
    ]


def test_a_failure_leaves_what_was_there(tmp_path: Path) -> None:
    log = make_log()
    convert([log], tmp_path, "x")
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    def broken() -> object:
        yield log
        raise LogError("the cable is out")

    with pytest.raises(LogError, match="cable"):
        convert(broken(), tmp_path, "x")  # type: ignore[arg-type]
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def csv(path: Path, start: float, rows: int = 50, head: str = "time,a\n") -> Path:
    path.write_text(head + "".join(f"{start + i / 10:.1f},{i}\n" for i in range(rows)))
    return path


def test_files_that_continue_one_another(tmp_path: Path) -> None:
    one, two, three = (csv(tmp_path / f"{i}.csv", start) for i, start in enumerate((0.0, 5.0, 0.0)))
    shares: list[float] = []
    log = join(read_continued([one, two, three], progress=shares.append))
    time = log.groups["data"].time
    np.testing.assert_allclose(time, np.arange(150) / 10)
    assert log.values("a").tolist() == [*range(50)] * 3
    assert [f["file"] for f in log.facts["files"]] == ["0.csv", "1.csv", "2.csv"]
    assert log.facts["notes"] == [
        "2.csv: its clock begins again at 0 s; put behind the last file, shifted by 10 s"
    ]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_files_with_dates_are_put_in_order(tmp_path: Path) -> None:
    for name, minute in (("b", 0), ("a", 2)):
        rows = "".join(f"2024-05-01 12:{minute:02}:{s:02},{s}\n" for s in range(30))
        (tmp_path / f"{name}.csv").write_text("time,a\n" + rows)
    log = join(read_continued([tmp_path / "a.csv", tmp_path / "b.csv"]))
    np.testing.assert_array_equal(log.groups["data"].time, [*range(30), *range(120, 150)])
    assert "notes" not in log.facts


def test_what_does_not_continue(tmp_path: Path) -> None:
    one, two = csv(tmp_path / "1.csv", 0.0), csv(tmp_path / "2.csv", 5.0, head="time,b\n")
    with pytest.raises(
        LogError, match=r"2\.csv does not continue .*1\.csv: in group 'data' it lacks a and has more: b"
    ):
        list(read_continued([one, two]))


def test_blocks_of_any_format_are_the_log(tmp_path: Path) -> None:
    for suffix in (".mcap", ".parquet", ".mf4"):
        path = write_log(make_log(), tmp_path / f"x{suffix}")
        assert join(read_blocks(path)).equals(read_log(path))
