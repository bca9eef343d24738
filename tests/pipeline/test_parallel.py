"""Batches in several processes, and what happens when some of them are killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest

from ingest import write_log
from ingest.errors import DynoscopeError
from ingest.log import Log
from pipeline import fit, load_recipe, run
from pipeline.batch import Options
from pipeline.detector import Detector
from pipeline.recipe import recipe_text

TWO = Options(timeline=False, workers=2)
DEADLY = '''
"""A stage that does not survive some logs."""
import os
from dataclasses import dataclass
from typing import ClassVar

@dataclass(frozen=True, kw_only=True)
class Deadly:
    version: ClassVar[str] = "1"
    needs = frozenset()
    adds = frozenset()
    def start(self): return None
    def step(self, state, block, /):
        if block.name.startswith("poison"):
            os.kill(os.getpid(), 9)
        return None, block
'''


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory, faulty: Log, healthy: list[Log]) -> Path:
    """Eight short drives, one cut off, one empty, one no log at all."""
    folder = tmp_path_factory.mktemp("many")
    for i in range(4):
        write_log(faulty.between(0.0, 200.0 + i), folder / f"faulty{i}.parquet")
        write_log(healthy[1].between(0.0, 100.0 + i), folder / f"healthy{i}.mcap")
    content = write_log(faulty, folder / "cut.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(content[: int(0.9 * len(content))])
    (folder / "empty.csv").touch()
    (folder / "noise.parquet").write_bytes(b"PAR1" + bytes(range(256)) * 20)
    return folder


@pytest.fixture(scope="module")
def deadly(
    tmp_path_factory: pytest.TempPathFactory, healthy: list[Log], monkeypatch_module: pytest.MonkeyPatch
) -> Detector:
    """A detector whose last stage kills the process on logs named poison."""
    folder = tmp_path_factory.mktemp("deadly")
    (folder / "deadly_stage.py").write_text(DEADLY)
    text = recipe_text("diesel_airpath") + '\n[[stage]]\nuse = "deadly_stage:Deadly"\n'
    (folder / "deadly.toml").write_text(text)
    monkeypatch_module.setattr(sys, "path", [*sys.path])
    return fit(healthy[:1], load_recipe(folder / "deadly.toml"), healthy[1:])


@pytest.fixture(scope="module")
def monkeypatch_module() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def serial(many: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one process made of them."""
    out = tmp_path_factory.mktemp("serial")
    run(sorted(many.iterdir()), detector, out, Options(timeline=False))
    return out


def same(one: Path, other: Path) -> bool:
    """Byte for byte."""
    names = ("summary.parquet", "summary.csv", "fleet.csv", "vehicles.json")
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in names)


def test_several_processes_make_what_one_makes(
    many: Path, serial: Path, detector: Detector, tmp_path: Path
) -> None:
    run(sorted(many.iterdir()), detector, tmp_path, TWO)
    assert same(tmp_path, serial)
    summary = pl.read_parquet(tmp_path / "summary.parquet")
    status = dict(summary.select("log", "status").iter_rows())
    assert status == {
        **{f"{kind}{i}": "ok" for i in range(4) for kind in ("faulty", "healthy")},
        "cut": "salvaged",
        "empty": "failed",
        "noise": "failed",
    }
    for log in summary.filter(pl.col("status") != "failed")["log"]:
        for file in ("samples.parquet", "verdict.json"):
            assert (tmp_path / log / file).read_bytes() == (serial / log / file).read_bytes()


def test_a_poison_log_is_found_and_set_aside(
    many: Path, logs: Path, deadly: Detector, tmp_path: Path
) -> None:
    shutil.copy(logs / "faulty.parquet", tmp_path / "poison.parquet")
    paths = [*sorted(many.glob("*[0-3].*")), tmp_path / "poison.parquet"]
    summary = run(paths, deadly, tmp_path / "out", TWO)
    assert summary["status"].to_list() == ["ok"] * 8 + ["failed"]
    assert summary["reason"][-1] == (
        "the process that worked on it was killed by SIGKILL, likely for want of memory"
    )
    assert not [p for p in (tmp_path / "out").iterdir() if p.name.startswith(".")]


def killed_batch(many: Path, store: Path, out: Path, after: int, signal_: int) -> int:
    """Run the command, and send it a signal once ``after`` logs are done; its exit status."""
    command = [sys.executable, "-m", "pipeline.cli", "run", str(many), "--recipe", "diesel_airpath"]
    command += ["--store", str(store), "--out", str(out), "--no-timeline", "--workers", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as main:
        assert main.stderr is not None
        for _ in range(after):
            main.stderr.readline()
        main.send_signal(signal_)
        main.stderr.read()
        return main.wait()


@pytest.mark.parametrize(("after", "how"), [(3, signal.SIGKILL), (2, signal.SIGINT)])
def test_a_killed_batch_goes_on_where_it_stopped(
    many: Path, serial: Path, detector: Detector, store_folder: Path, tmp_path: Path, after: int, how: int
) -> None:
    out = tmp_path / "out"
    status = killed_batch(many, store_folder, out, after, how)
    assert status == (130 if how == signal.SIGINT else -how)
    so_far = pl.read_parquet(out / "summary.parquet")
    assert after <= so_far.height < 11
    if how == signal.SIGINT:
        assert not [p for p in out.iterdir() if p.name.startswith(".")]
    before = {log: (out / log).stat().st_ino for log in so_far["log"] if (out / log).exists()}
    run(sorted(many.iterdir()), detector, out, TWO)
    assert same(out, serial)
    assert all((out / log).stat().st_ino == inode for log, inode in before.items())
    assert not [p for p in out.iterdir() if p.name.startswith(".")]


@pytest.fixture(scope="module")
def store_folder(store: object) -> Path:
    return store.folder  # type: ignore[attr-defined,no-any-return]


def workers_of(pid: int) -> list[int]:
    """The processes that a batch works with."""
    found = [c for t in Path(f"/proc/{pid}/task").iterdir() for c in (t / "children").read_text().split()]
    return [int(c) for c in found if b"pipeline.engines" in Path(f"/proc/{c}/cmdline").read_bytes()]


def test_workers_that_are_killed_lose_nothing(
    many: Path, serial: Path, detector: Detector, tmp_path: Path
) -> None:
    killed: set[int] = set()

    def kill_one(log: str, row: object) -> None:
        workers = workers_of(os.getpid())
        if workers and len(killed) < 2:  # at most two of the three attempts at one log
            os.kill(workers[0], signal.SIGKILL)
            killed.add(workers[0])

    run(sorted(many.iterdir()), detector, tmp_path, TWO, kill_one)
    assert len(killed) == 2
    assert same(tmp_path, serial)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, list[int]]]:
    """A real scheduler on loopback, and two real workers: its address and their pids."""
    pytest.importorskip("distributed")
    folder = tmp_path_factory.mktemp("cluster")
    found = ["--scheduler-file", str(folder / "scheduler.json"), "--no-dashboard", "--host", "127.0.0.1"]

    def dask(*words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{words[0]}", *found, *words[1:]]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder)

    scheduler = dask("scheduler", "--port", "0")
    workers = [dask("worker", "--nthreads", "1", "--no-nanny") for _ in range(2)]
    for _ in range(300):
        if (folder / "scheduler.json").exists():
            break
        time.sleep(0.1)
    address = json.loads((folder / "scheduler.json").read_text())["address"]
    yield address, [w.pid for w in workers]
    for process in (*workers, scheduler):
        process.kill()
        process.wait()


def test_a_cluster_of_which_a_worker_is_killed(
    cluster: tuple[str, list[int]], many: Path, serial: Path, detector: Detector, tmp_path: Path
) -> None:
    address, pids = cluster
    done: list[str] = []

    def kill_one(log: str, row: object) -> None:
        done.append(log)
        if len(done) == 3:
            os.kill(pids[0], signal.SIGKILL)

    run(sorted(many.iterdir()), detector, tmp_path, Options(timeline=False, scheduler=address), kill_one)
    assert len(done) == 11
    assert same(tmp_path, serial)


def test_a_scheduler_that_is_not_there(
    many: Path, detector: Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("pipeline.cluster.TIMEOUT_S", 1)
    with pytest.raises(DynoscopeError, match=r"tcp://127.0.0.1:9: no scheduler answers"):
        run(
            sorted(many.iterdir()), detector, tmp_path,
            Options(timeline=False, scheduler="tcp://127.0.0.1:9"),
        )  # fmt: skip
