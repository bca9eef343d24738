from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ingest import read_log, write_log
from ingest.errors import StoreError
from ingest.log import Log
from pipeline import run
from pipeline.batch import Options
from pipeline.cache import Cache
from pipeline.cli import main
from pipeline.detector import Detector


@pytest.fixture
def csv(faulty: Log, tmp_path: Path) -> Path:
    return write_log(faulty.between(0.0, 200.0), tmp_path / "drive.csv")


def forbid(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    def fails(*_: Any, **__: Any) -> Any:
        raise AssertionError(f"{name} was called")

    monkeypatch.setattr(f"pipeline.task.{name}", fails)


def test_a_finished_run_is_had_from_the_cache(
    csv: Path, detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = Options(timeline=False, cache=tmp_path / "cache")
    first = run([csv], detector, tmp_path / "one", options)
    forbid(monkeypatch, "read_log")
    again = run([csv], detector, tmp_path / "two", options)
    assert again.equals(first)
    for file in (tmp_path / "one" / "drive").iterdir():
        assert (tmp_path / "two" / "drive" / file.name).read_bytes() == file.read_bytes()
    forbid(monkeypatch, "diagnose")
    (row,) = run([csv], detector, tmp_path / "two", replace(options, force=True)).to_dicts()
    assert row["reason"] == "AssertionError: diagnose was called"


def test_a_read_log_serves_another_detector(
    csv: Path, detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = Options(timeline=False, cache=tmp_path / "cache")
    run([csv], detector, tmp_path / "one", options)
    other = replace(detector, record={**detector.record, "key": "f" * 32})
    forbid(monkeypatch, "read_log")
    (row,) = run([csv], other, tmp_path / "two", options).to_dicts()
    assert (row["status"], row["detector"]) == ("ok", "f" * 32)


def test_what_is_damaged_is_made_again(csv: Path, detector: Detector, tmp_path: Path) -> None:
    options = Options(timeline=False, cache=tmp_path / "cache")
    first = run([csv], detector, tmp_path / "one", options)
    (log,) = (tmp_path / "cache" / "logs").iterdir()
    log.write_bytes(log.read_bytes()[:-100])
    (kept,) = (tmp_path / "cache" / "runs").iterdir()
    (kept / "verdict.json").unlink()
    (kept / "verdict.json").write_text("{")
    assert run([csv], detector, tmp_path / "two", options).equals(first)
    assert read_log(log).equals(read_log(csv))
    assert json.loads((kept / "verdict.json").read_text())["fault"]
    assert json.loads((tmp_path / "one" / "drive" / "verdict.json").read_text())["fault"]


def test_the_log_comes_back_as_it_was_read(csv: Path, tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache")
    read = read_log(csv)
    assert cache.log("a", None, lambda: read).equals(read)
    assert cache.log("a", None, lambda: pytest.fail("read again")).equals(read)
    assert cache.log("a", "map", lambda: read) is read  # another map is another log


def test_a_cache_that_is_no_folder_is_said_before_anything_begins(
    csv: Path, detector: Detector, tmp_path: Path
) -> None:
    (tmp_path / "cache").touch()
    with pytest.raises(StoreError, match=r"cache .* cannot be written: .* run without --cache"):
        run([csv], detector, tmp_path / "out", Options(cache=tmp_path / "cache"))
    assert not (tmp_path / "out").exists()


def test_a_full_disk_leaves_no_half_file(csv: Path, tmp_path: Path) -> None:
    code = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from ingest import read_log\n"
        "from pipeline.cache import Cache\n"
        "log = read_log(sys.argv[1])\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, {resource.RLIM_INFINITY}))\n"
        "try:\n"
        "    Cache(Path(sys.argv[2])).log('a', None, lambda: log)\n"
        "except Exception as error:\n"
        "    print(type(error).__name__, error)\n"
    )
    command = [sys.executable, "-c", code, str(csv), str(tmp_path / "cache")]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert said.startswith("StoreError cache ")
    assert "make room with `dynoscope cache prune`" in said
    assert list((tmp_path / "cache" / "logs").iterdir()) == []


def test_prune_takes_what_was_not_used_for_longest(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    for i, key in enumerate("abc"):
        (tmp_path / "logs").mkdir(exist_ok=True)
        (tmp_path / "logs" / f"{key}.parquet").write_bytes(bytes(100))
        os.utime(tmp_path / "logs" / f"{key}.parquet", (time.time() - 86400 * (3 - i),) * 2)
    assert [e.path.stem for e in cache.entries()] == ["a", "b", "c"]
    assert [e.path.stem for e in cache.prune(older_than_s=2.5 * 86400)] == ["a"]
    assert [e.path.stem for e in cache.prune(keep_bytes=150)] == ["b"]
    assert [e.path.stem for e in cache.prune()] == ["c"]
    assert cache.entries() == []


def test_commands(csv: Path, detector: Detector, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "cache"
    run([csv], detector, tmp_path / "one", Options(timeline=False, cache=folder))
    assert main(["cache", "info", "--cache", str(folder), "--json"]) == 0
    info = json.loads(capsys.readouterr().out)
    assert (info["logs"], info["runs"]) == (1, 1)
    assert info["runs_bytes"] > 10_000
    assert main(["cache", "prune", "--cache", str(folder)]) == 0
    assert "removed: 2" in capsys.readouterr().out
    assert main(["cache", "info", "--cache", str(tmp_path / "nowhere")]) == 2
