from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from ingest import write_log
from ingest.errors import LogError
from ingest.log import Log
from pipeline import diagnose, run
from pipeline.batch import Options, to_do
from pipeline.detector import Detector
from pipeline.summary import SUMMARY_SCHEMA

PLAIN = Options(timeline=False)


@pytest.fixture(scope="module")
def done(logs: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished batch of two logs; not to be changed."""
    out = tmp_path_factory.mktemp("batch") / "out"
    run([logs / "faulty.parquet", logs / "healthy2.parquet"], detector, out, PLAIN)
    return out


@pytest.fixture
def again(done: Path, logs: Path, tmp_path: Path) -> tuple[list[Path], Path]:
    """A copy of the batch and of its logs, to be changed."""
    shutil.copytree(done, tmp_path / "out")
    paths = [tmp_path / name for name in ("faulty.parquet", "healthy2.parquet")]
    for path in paths:
        shutil.copy(logs / path.name, path)
    return paths, tmp_path / "out"


def inodes(out: Path) -> dict[str, int]:
    """A run's folder is replaced as a whole, so its inode tells whether it was made again."""
    return {p.name: p.stat().st_ino for p in out.iterdir() if p.is_dir()}


def made_again(paths: list[Path], detector: Detector, out: Path, options: Options = PLAIN) -> set[str]:
    before = inodes(out)
    run(paths, detector, out, options)
    return {name for name, inode in inodes(out).items() if before.get(name) != inode}


def test_summary(done: Path, detector: Detector) -> None:
    summary = pl.read_parquet(done / "summary.parquet")
    assert dict(summary.schema) == SUMMARY_SCHEMA
    faulty, healthy = summary.to_dicts()
    assert (faulty["log"], faulty["status"], faulty["reason"]) == ("faulty", "ok", None)
    assert (faulty["fault"], faulty["signal"], faulty["truth"]) == (
        "maf_gain",
        "W_HFM",
        faulty["fault"],
    )
    assert (faulty["recipe"], faulty["detector"]) == ("diesel_airpath", detector.key)
    assert 0.05 < faulty["p"] <= 1
    assert faulty["fault"] in faulty["set"].split()
    assert (healthy["fault"], healthy["set"], healthy["onset_s"], healthy["truth"]) == (
        "none",
        "",
        None,
        "none",
    )
    assert pl.read_csv(done / "summary.csv").columns == list(SUMMARY_SCHEMA)


def test_summary_is_that_of_the_verdicts(done: Path) -> None:
    for row in pl.read_parquet(done / "summary.parquet").iter_rows(named=True):
        verdict = json.loads((done / row["log"] / "verdict.json").read_text())
        assert {k: verdict[k] for k in ("fault", "signal", "onset_s", "detected_s")} == {
            k: row[k] for k in ("fault", "signal", "onset_s", "detected_s")
        }


def test_one_bad_log_does_not_stop_the_rest(logs: Path, detector: Detector, tmp_path: Path) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1 and then nothing")
    (tmp_path / "other.csv").write_text("time,p_Boost\n0,1\n1,2\n")
    seen: list[tuple[str, str, int]] = []

    def progress(name: str, row: dict[str, Any]) -> None:
        summary = pl.read_parquet(tmp_path / "out" / "summary.parquet")
        assert summary["log"][-1] == name  # right after every log
        seen.append((name, row["status"], summary.height))

    paths = [
        tmp_path / "bad.parquet",
        tmp_path / "nowhere.mcap",
        tmp_path / "other.csv",
        logs / "faulty.parquet",
    ]
    summary = run(paths, detector, tmp_path / "out", PLAIN, progress)
    assert seen == [
        ("bad", "failed", 1),
        ("nowhere", "failed", 2),
        ("other", "failed", 3),
        ("faulty", "ok", 4),
    ]
    bad, nowhere, other, ok = summary.to_dicts()
    assert bad["reason"].startswith("bad.parquet")
    assert nowhere["reason"] == "nowhere.mcap: there is no such file"
    assert "has no signal 'p_" in other["reason"]
    assert ok["fault"] == "maf_gain"
    files = {"summary.csv", "summary.parquet", "fleet.csv", "vehicles.json"}
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"faulty", *files}


@pytest.mark.parametrize(
    "error",
    [ZeroDivisionError("oops"), MemoryError(), OSError(28, "No space left"), pl.exceptions.ComputeError("x")],
)
def test_whatever_happens_to_one_log_the_rest_is_done(
    logs: Path, detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fails_once(log: Log, *args: Any, **settings: Any) -> Any:
        if log.name == "healthy1":
            raise error
        return diagnose(log, *args, **settings)

    monkeypatch.setattr("pipeline.task.diagnose", fails_once)
    summary = run([logs / "healthy1.parquet", logs / "faulty.parquet"], detector, tmp_path, PLAIN)
    assert summary["status"].to_list() == ["failed", "ok"]
    assert type(error).__name__ in summary["reason"][0]


def test_nothing_is_done_twice(again: tuple[list[Path], Path], detector: Detector) -> None:
    paths, out = again
    before = (out / "summary.parquet").read_bytes()
    assert made_again(paths, detector, out) == set()
    assert (out / "summary.parquet").read_bytes() == before


def test_force(again: tuple[list[Path], Path], detector: Detector) -> None:
    paths, out = again
    assert made_again(paths, detector, out, replace(PLAIN, force=True)) == {"faulty", "healthy2"}


def test_a_changed_log_is_done_again(again: tuple[list[Path], Path], faulty: Log, detector: Detector) -> None:
    paths, out = again
    write_log(faulty.between(0.0, 300.0), paths[0])
    assert made_again(paths, detector, out) == {"faulty"}


def test_a_touched_log_is_not(again: tuple[list[Path], Path], detector: Detector) -> None:
    paths, out = again
    os.utime(paths[0], (0, 0))
    assert made_again(paths, detector, out) == set()


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("samples.parquet", None),
        ("annotated.mcap", None),
        ("verdict.json", None),
        ("verdict.json", ""),
        ("verdict.json", "[]"),
        ("manifest.json", "{"),
        ("manifest.json", "{}"),
    ],
)
def test_an_incomplete_run_is_done_again(
    again: tuple[list[Path], Path], detector: Detector, file: str, content: str | None
) -> None:
    paths, out = again
    (out / "faulty" / file).unlink()
    if content is not None:
        (out / "faulty" / file).write_text(content)
    assert made_again(paths, detector, out) == {"faulty"}


def test_a_missing_timeline_is_added(again: tuple[list[Path], Path], detector: Detector) -> None:
    paths, out = again
    assert made_again(paths[:1], detector, out, Options()) == {"faulty"}
    assert (out / "faulty" / "timeline.rrd").stat().st_size > 1000
    assert made_again(paths[:1], detector, out, PLAIN) == set()  # and one too many is no reason


def test_another_map_is_a_reason(again: tuple[list[Path], Path], detector: Detector, tmp_path: Path) -> None:
    paths, out = again
    (tmp_path / "map.toml").write_text('vehicle = "x"\n')
    assert made_again(paths[:1], detector, out, replace(PLAIN, name_map=tmp_path / "map.toml")) == {"faulty"}


def test_two_logs_of_one_stem(logs: Path, healthy: list[Log], detector: Detector, tmp_path: Path) -> None:
    write_log(healthy[1], tmp_path / "faulty.mcap")
    summary = run([logs / "faulty.parquet", tmp_path / "faulty.mcap"], detector, tmp_path / "out", PLAIN)
    names = summary["log"].to_list()
    assert all(name.startswith("faulty-") and len(name) == len("faulty-") + 8 for name in names)
    assert len(set(names)) == 2
    assert summary["fault"].to_list() == ["maf_gain", "none"]
    assert json.loads((tmp_path / "out" / names[0] / "verdict.json").read_text())["log"] == names[0]


def test_summary_does_not_depend_on_place_or_time(logs: Path, detector: Detector, tmp_path: Path) -> None:
    content = []
    for place in ("place_a", "place_b"):
        folder = tmp_path / place
        folder.mkdir()
        shutil.copy(logs / "faulty.parquet", folder)
        (folder / "bad.parquet").write_bytes(b"PAR1 and then nothing")
        (folder / "other.csv").write_text("time,p_Boost\n0,1\n1,2\n")
        names = ("bad.parquet", "nowhere.mcap", "other.csv", "faulty.parquet")
        run([*(folder / n for n in names), folder / "gone" / "x.csv"], detector, folder / "out", PLAIN)
        files = ("summary.parquet", "summary.csv", "faulty/samples.parquet", "faulty/verdict.json")
        content.append([(folder / "out" / f).read_bytes() for f in files])
        assert place not in (folder / "out" / "summary.csv").read_text()
    assert content[0] == content[1]


def test_a_salvaged_log_is_called_so(logs: Path, detector: Detector, faulty: Log, tmp_path: Path) -> None:
    write_log(faulty, tmp_path / "cut.mcap")
    content = (tmp_path / "cut.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: int(0.9 * len(content))])
    first = run([tmp_path / "cut.mcap"], detector, tmp_path / "out", PLAIN)
    (row,) = first.to_dicts()
    assert row["status"] == "salvaged"
    assert row["reason"]
    assert run([tmp_path / "cut.mcap"], detector, tmp_path / "out", PLAIN).equals(first)  # also when resumed


def test_inputs_are_not_changed(again: tuple[list[Path], Path], detector: Detector) -> None:
    paths, _ = again
    before = [p.read_bytes() for p in paths]
    out = paths[0].parent / "beside"
    run(paths, detector, out, PLAIN)
    assert [p.read_bytes() for p in paths] == before


def test_out_that_is_a_file_or_cannot_hold_the_summary(
    logs: Path, detector: Detector, tmp_path: Path
) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(LogError, match=r"output folder .* cannot be made"):
        run([logs / "faulty.parquet"], detector, tmp_path / "x", PLAIN)
    (tmp_path / "out" / "summary.parquet").mkdir(parents=True)
    with pytest.raises(LogError, match=r"summary in .* cannot be written"):
        run([logs / "faulty.parquet"], detector, tmp_path / "out", PLAIN)


def test_regime_of_samples_lies_on_the_map(done: Path, detector: Detector) -> None:
    regime = pl.read_parquet(done / "faulty" / "samples.parquet")["regime"].to_numpy()
    nodes = next(v for k, v in detector.arrays.items() if k.endswith("map/nodes"))
    assert regime.min() >= -1
    assert regime.max() < len(nodes)
    assert len(np.unique(regime)) > 3


def test_driving_cycles_of_a_fleet(
    logs: Path, faulty: Log, healthy: list[Log], detector: Detector, tmp_path: Path
) -> None:
    def drive(log: Log, path: str) -> Path:
        nobody = {k: v for k, v in log.facts.items() if k != "vehicle"}
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        return write_log(replace(log, facts=nobody), tmp_path / path)

    first = [drive(faulty, "fleet/car/drive9.parquet"), drive(healthy[1], "fleet/van/drive1.parquet")]
    run(first, detector, tmp_path / "out", PLAIN)
    shutil.rmtree(tmp_path / "out" / "drive9")  # its cycle is remembered
    later = [
        drive(faulty.between(0.0, 300.0), "fleet/car/drive10.parquet"),
        drive(healthy[0], "fleet/van/drive2.parquet"),
    ]
    run(later, detector, tmp_path / "out", PLAIN)
    rows = {row["log"]: row for row in pl.read_parquet(tmp_path / "out" / "summary.parquet").to_dicts()}
    assert set(rows) == {"drive10", "drive1", "drive2"}
    codes = {log: (row["vehicle"], row["cycle"], row["fault_codes"], row["mil"]) for log, row in rows.items()}
    assert codes == {
        "drive10": ("car", 2, "maf_gain:confirmed", True),
        "drive1": ("van", 1, None, False),
        "drive2": ("van", 2, None, False),
    }
    fleet = pl.read_csv(tmp_path / "out" / "fleet.csv")
    assert fleet.select("vehicle", "logs", "faulty", "last_log").rows() == [
        ("car", 1, 1, "drive10"),
        ("van", 2, 0, "drive2"),
    ]


def test_only_failed(again: tuple[list[Path], Path], detector: Detector, tmp_path: Path) -> None:
    paths, out = again
    good = paths[0].read_bytes()
    paths[0].write_bytes(b"PAR1")
    run(paths, detector, out, PLAIN)
    options = replace(PLAIN, only_failed=True)
    intents = dict(to_do(paths, detector, out, options))
    assert intents == {"faulty": "run: it failed before", "healthy2": "leave: it has not failed"}
    paths[0].write_bytes(good)
    paths[1].write_bytes(b"changed, but it did not fail")
    summary = run(paths, detector, out, options)
    assert summary["status"].to_list() == ["ok", "ok"]
    assert dict(to_do(paths, detector, out, PLAIN))["healthy2"] == "run: changed or incomplete"


def test_a_dry_run_changes_nothing(logs: Path, detector: Detector, tmp_path: Path) -> None:
    paths = [logs / "faulty.parquet", tmp_path / "nowhere.csv"]
    assert to_do(paths, detector, tmp_path / "out", PLAIN) == [
        ("faulty", "run: new"),
        ("nowhere", "run: new"),
    ]
    assert not (tmp_path / "out").exists()
    run(paths, detector, tmp_path / "out", PLAIN)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("*")}
    assert dict(to_do(paths, detector, tmp_path / "out", PLAIN)) == {
        "faulty": "done",
        "nowhere": "run: it failed before",
    }
    assert (
        dict(to_do(paths, detector, tmp_path / "out", replace(PLAIN, force=True)))["faulty"] == "run: forced"
    )
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("*")} == before


def test_logs_of_earlier_calls_stay_in_the_summary(logs: Path, detector: Detector, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run([logs / "healthy2.parquet", tmp_path / "nowhere.csv"], detector, out, PLAIN)
    only = run([logs / "faulty.parquet"], detector, out, PLAIN)
    assert only["log"].to_list() == ["faulty"]  # what this call was about
    kept = pl.read_parquet(out / "summary.parquet")
    assert kept.select("log", "status").rows() == [
        ("faulty", "ok"),
        ("healthy2", "ok"),
        ("nowhere", "failed"),
    ]
    shutil.rmtree(out / "healthy2")
    run([logs / "faulty.parquet"], detector, out, PLAIN)
    assert pl.read_parquet(out / "summary.parquet")["log"].to_list() == ["faulty", "nowhere"]


@pytest.mark.parametrize("content", [b"", b"PAR1 no more", None])
def test_a_summary_that_cannot_be_read_is_made_anew(
    again: tuple[list[Path], Path], detector: Detector, content: bytes | None
) -> None:
    paths, out = again
    before = (out / "summary.parquet").read_bytes()
    (out / "summary.parquet").unlink()
    if content is not None:
        (out / "summary.parquet").write_bytes(content)
    assert made_again(paths, detector, out) == set()
    assert (out / "summary.parquet").read_bytes() == before
