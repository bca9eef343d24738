"""Logs behind URLs: an S3 server of our own on this machine, and a scheme that only fsspec knows."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import polars as pl
import pytest

from ingest import read_log, write_log
from ingest.errors import LogError
from ingest.files import find_logs
from ingest.log import Group, Log
from pipeline.cli import main

fsspec = pytest.importorskip("fsspec")
server = pytest.importorskip("moto.server")


def make_log(name: str = "x") -> Log:
    return Log(name, {"g": Group("g", pl.DataFrame({"time": [0.0, 1.0], "a": [1.0, 2.0]}))})


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The options of a URL that leads to the server; bucket ``bench`` holds two logs and a note."""
    from pyarrow.fs import FileSystem

    saved = dict(os.environ)
    os.environ |= {
        "AWS_ACCESS_KEY_ID": "x",
        "AWS_SECRET_ACCESS_KEY": "x",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    moto = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    moto.start()
    _, port = moto.get_host_and_port()
    found = f"?endpoint_override=127.0.0.1:{port}&scheme=http&region=us-east-1&allow_bucket_creation=true"
    system, _ = FileSystem.from_uri(f"s3://bench{found}")
    system.create_dir("bench")
    folder = tmp_path_factory.mktemp("s3")
    for name in ("run/a.mcap", "run/b.csv", "run/deep/c.parquet", "run/notes.md"):
        path = folder / name
        if path.suffix == ".md":
            path.write_text("no log")
        else:
            write_log(make_log(path.stem), path)
        with system.open_output_stream(f"bench/{name}") as stream:
            stream.write(path.read_bytes())
    yield found
    moto.stop()
    os.environ.clear()
    os.environ.update(saved)


def test_one_object(options: str) -> None:
    (path,) = find_logs([f"s3://bench/run/a.mcap{options}"])
    assert path.name == "a.mcap"
    assert read_log(path).equals(make_log("a"))
    assert read_log(f"s3://bench/run/a.mcap{options}").equals(make_log("a"))


def test_a_folder_and_globs(options: str) -> None:
    assert [p.name for p in find_logs([f"s3://bench/run{options}"])] == ["a.mcap", "b.csv"]
    assert [p.name for p in find_logs([f"s3://bench/run/*.csv{options}"])] == ["b.csv"]
    assert [p.name for p in find_logs([f"s3://bench/**/*.parquet{options}"])] == ["c.parquet"]


def test_ingest_from_there(options: str, tmp_path: Path) -> None:
    assert main(["ingest", f"s3://bench/run{options}", "--out", str(tmp_path)]) == 0
    assert read_log(tmp_path / "b.mcap").values("a").tolist() == [1.0, 2.0]


def test_what_is_not_there(options: str) -> None:
    for url, words in (
        (f"s3://bench/run/none.mcap{options}", "none.mcap"),
        (f"s3://nowhere/x.csv{options}", "nowhere"),
        (f"s3://bench/run/*.mf4{options}", r"no file there fits \*\.mf4"),
        ("nosuch://a/b.csv", "nosuch"),
    ):
        with pytest.raises(LogError, match=words):
            find_logs([url])
    with pytest.raises(LogError, match=r"none\.mcap"):
        read_log(Path(f"s3://bench/run/none.mcap{options}"))


def test_schemes_of_fsspec(tmp_path: Path) -> None:
    content = write_log(make_log("x"), tmp_path / "x.mcap").read_bytes()
    memory = fsspec.filesystem("memory")
    for name in ("x.mcap", "y.mcap"):
        memory.pipe(f"/logs/{name}", content)
    assert [p.name for p in find_logs(["memory://logs"])] == ["x.mcap", "y.mcap"]
    assert read_log("memory://logs/x.mcap").equals(make_log("x"))


def test_a_password_is_not_repeated() -> None:
    with pytest.raises(LogError) as caught:
        find_logs(["nosuch://me:secret@host/x.csv"])
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_a_worker_leaves_nothing_behind(method: str) -> None:
    """What it fetched lay in a folder of its own."""
    from ingest import remote

    with ProcessPoolExecutor(1, mp_context=get_context(method)) as pool:
        folder = Path(pool.submit(remote._folder).result())
        assert folder.is_dir()
    assert not folder.exists()
