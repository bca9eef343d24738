"""Batches from and to an object store: an S3 server of our own on this machine."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from ingest.files import find_logs
from pipeline import run
from pipeline.batch import Options, to_do
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.remote_out import fetch_folder, send_files
from pipeline.store import Store

server = pytest.importorskip("moto.server")
PLAIN = Options(timeline=False)


@pytest.fixture(scope="module")
def options(logs: Path) -> Iterator[str]:
    """The options of a URL that leads to the server; bucket ``fleet`` holds two drives."""
    from pyarrow.fs import FileSystem

    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_EC2_METADATA_DISABLED"):
            patch.setenv(name, "true")
        moto = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        moto.start()
        _, port = moto.get_host_and_port()
        found = f"?endpoint_override=127.0.0.1:{port}&scheme=http&region=us-east-1&allow_bucket_creation=true"
        system, _ = FileSystem.from_uri(f"s3://fleet{found}")
        system.create_dir("fleet")
        send_files([logs / "faulty.parquet", logs / "healthy2.parquet"], f"s3://fleet/drives{found}")
        yield found
        moto.stop()


@pytest.fixture(scope="module")
def local(logs: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same batch from and to this machine."""
    out = tmp_path_factory.mktemp("local")
    run([logs / "faulty.parquet", logs / "healthy2.parquet"], detector, out, PLAIN)
    return out


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An own folder for temporary files."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    return tmp_path / "tmp"


def test_logs_are_fetched_one_by_one_and_not_kept(
    options: str, local: Path, detector: Detector, tmp_path: Path, temporary: Path
) -> None:
    paths = find_logs([f"s3://fleet/drives{options}"], remote=True)
    assert list(temporary.iterdir()) == []  # nothing is fetched yet
    largest: list[int] = []

    def look(log: str, row: dict[str, Any]) -> None:
        largest.append(len(list(temporary.rglob("*.parquet"))))

    run(paths, detector, tmp_path / "out", PLAIN, look)
    assert largest == [0, 0]
    assert (tmp_path / "out" / "summary.parquet").read_bytes() == (local / "summary.parquet").read_bytes()
    path = json.loads((tmp_path / "out" / "faulty" / "manifest.json").read_text())["log"]["path"]
    assert path.startswith("s3://fleet/drives/faulty.parquet")


def test_an_object_that_has_gone_costs_itself_only(
    options: str, detector: Detector, tmp_path: Path, temporary: Path
) -> None:
    paths = [Path(f"s3://fleet/drives/{n}.parquet{options}") for n in ("gone", "healthy2")]
    gone, there = run(paths, detector, tmp_path / "out", PLAIN).to_dicts()
    assert (gone["log"], gone["status"], there["status"]) == ("gone", "failed", "ok")
    assert gone["reason"].startswith("gone.parquet cannot be read")
    assert str(temporary) not in gone["reason"]


def test_out_behind_a_url(options: str, local: Path, detector: Detector, tmp_path: Path) -> None:
    out = Path(f"s3://fleet/out{options}")
    paths = find_logs([f"s3://fleet/drives{options}"], remote=True)
    run(paths, detector, out, Options(timeline=False, workers=2))
    fetch_folder(
        str(out).replace(":/", "://", 1), tmp_path / "copy", os.listdir(local / "faulty") + os.listdir(local)
    )
    for name in ("summary.parquet", "summary.csv", "fleet.csv", "vehicles.json"):
        assert (tmp_path / "copy" / name).read_bytes() == (local / name).read_bytes()
    for name in ("samples.parquet", "verdict.json"):
        assert (tmp_path / "copy" / "faulty" / name).read_bytes() == (local / "faulty" / name).read_bytes()
    assert to_do(paths, detector, out, PLAIN) == [("faulty", "done"), ("healthy2", "done")]
    made: list[Any] = []
    again = run(paths, detector, out, PLAIN, lambda log, row: made.append(row))
    assert again.equals(pl.read_parquet(local / "summary.parquet"))


def test_command(options: str, store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", f"s3://fleet/drives/faulty.parquet{options}", "--recipe", "diesel_airpath"]
    words += ["--store", str(store.folder), "--out", str(tmp_path / "out"), "--no-timeline"]
    assert main([*words, "--dry-run"]) == 0
    assert "run: new" in capsys.readouterr().out
    assert main(words) == 0
    assert "maf_gain" in capsys.readouterr().out
    shutil.rmtree(tmp_path / "out" / "faulty")
    assert main([*words, "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"log": "faulty", "would": "run: new"}]
