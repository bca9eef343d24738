"""Tasks are builtins, since a worker process must be able to import what it is to do."""

from __future__ import annotations

import operator
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import wait
from pathlib import Path

import pytest

from ingest.errors import DynoscopeError
from pipeline.engines import ONE_THREAD, Processes, Serial, WorkerDiedError


@pytest.fixture(scope="module")
def two() -> Iterator[Processes]:
    engine = Processes(2)
    yield engine
    engine.shutdown()


@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_results_and_errors_come_back(kind: str, two: Processes) -> None:
    engine = Serial() if kind == "serial" else two
    futures = [engine.submit(operator.truediv, 6, n) for n in (1, 2, 0, 3)]
    wait(futures)
    assert [f.result() for f in futures if not f.exception()] == [6.0, 3.0, 2.0]
    assert isinstance(futures[2].exception(), ZeroDivisionError)


def test_two_at_a_time_in_processes_of_their_own_with_one_thread_each(two: Processes) -> None:
    code = "__import__('time').sleep(0.5) or __import__('os').getpid()"
    pids = {f.result() for f in [two.submit(eval, code) for _ in range(4)]}
    assert len(pids) == 2
    assert os.getpid() not in pids
    for name in ONE_THREAD:
        assert two.submit(eval, f"__import__('os').environ[{name!r}]").result() is not None


def test_a_task_that_kills_its_worker_costs_itself_only(two: Processes) -> None:
    futures = [two.submit(operator.add, 1, n) for n in range(3)]
    deadly = two.submit(signal.raise_signal, signal.SIGKILL)
    leaves = two.submit(os._exit, 3)
    futures += [two.submit(operator.add, 1, n) for n in range(3, 8)]
    assert [f.result() for f in futures] == [1 + n for n in range(8)]
    with pytest.raises(WorkerDiedError, match="was killed by SIGKILL, likely for want of memory"):
        deadly.result()
    with pytest.raises(WorkerDiedError, match="ended with status 3"):
        leaves.result()


def test_a_worker_that_dies_once_is_replaced_and_its_task_done(two: Processes, tmp_path: Path) -> None:
    code = (
        "import os, pathlib\n"
        f"path = pathlib.Path({str(tmp_path / 'pid')!r})\n"
        "first = not path.exists()\n"
        "path.write_text(str(os.getpid()))\n"
        "if first: os.kill(os.getpid(), 9)\n"
    )
    assert two.submit(exec, code).result() is None


def test_what_cannot_be_sent_is_said(two: Processes) -> None:
    with pytest.raises(DynoscopeError, match="cannot load its task"):
        two.submit(_not_importable_elsewhere).result()
    assert two.submit(max, 1, 2).result() == 2


def _not_importable_elsewhere() -> None: ...


_not_importable_elsewhere.__module__ = "no_such_module"
sys.modules["no_such_module"] = sys.modules[__name__]


def test_abandon_is_quick_and_nothing_is_tried_again() -> None:
    engine = Processes(1)
    running, waiting = engine.submit(time.sleep, 60), engine.submit(time.sleep, 60)
    time.sleep(1.0)
    began = time.perf_counter()
    engine.abandon()
    assert waiting.cancelled()
    assert isinstance(running.exception(timeout=10), WorkerDiedError)
    assert time.perf_counter() - began < 5.0


def test_workers_go_with_their_parent(tmp_path: Path) -> None:
    code = (
        "import os, sys, time\n"
        "from pipeline.engines import Processes\n"
        "if __name__ == '__main__':\n"
        "    engine = Processes(1)\n"
        "    print(engine.submit(os.getpid).result(), flush=True)\n"
        "    engine.submit(time.sleep, 60).result()\n"
    )
    (tmp_path / "main.py").write_text(code)
    with subprocess.Popen([sys.executable, tmp_path / "main.py"], stdout=subprocess.PIPE, text=True) as main:
        assert main.stdout is not None
        worker = int(main.stdout.readline())
        os.kill(worker, 0)
        main.kill()
    for _ in range(100):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise AssertionError("the worker outlived its parent")
