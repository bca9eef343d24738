"""Where logs are processed: here, in processes of this machine, or on a cluster, behind one interface.

An engine is a :class:`concurrent.futures.Executor`, with a ``window``: how many tasks may wait or run at a
time. What a task raises comes back as its future's exception, and so does :class:`WorkerDiedError`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, ParamSpec, Protocol, TypeVar

from ingest.errors import DynoscopeError
from ingest.threads import Inline

P = ParamSpec("P")
T = TypeVar("T")
ATTEMPTS = 3  # a worker may die of what its neighbours do; over one log again and again, it is the log
ONE_THREAD = ("POLARS_MAX_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class WorkerDiedError(DynoscopeError):
    """The process that worked on a log has gone; the other logs are not concerned."""


class Engine(Protocol):
    """An executor that says how many tasks it wants at a time, and can be left at once."""

    @property
    def window(self) -> int: ...
    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]: ...
    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None: ...
    def abandon(self) -> None:
        """Drop what waits and stop what runs; whatever is written appears whole or not at all."""


class Serial(Inline):
    """Everything in this process, one after the other."""

    window = 1

    def abandon(self) -> None:
        """Nothing runs between two submits."""


class Processes(Executor):
    """``workers`` processes, each with one task at a time, so that it is known which task a death belongs to.

    A task whose worker dies is tried again in a new one, ``ATTEMPTS`` times in all; then its future raises
    :class:`WorkerDiedError`. A worker ends with the process that started it.
    """

    def __init__(self, workers: int) -> None:
        self.window = 2 * workers
        self._threads = ThreadPoolExecutor(workers)
        self._workers = [_Worker() for _ in range(workers)]
        self._idle: SimpleQueue[_Worker] = SimpleQueue()
        for worker in self._workers:
            self._idle.put(worker)
        self._abandoned = False

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        return self._threads.submit(self._attempt, fn, args, kwargs)

    def _attempt(self, fn: Callable[..., T], args: Any, kwargs: Any) -> T:
        worker = self._idle.get()
        try:
            for attempt in range(1, ATTEMPTS + 1):
                try:
                    return worker.call(fn, args, kwargs)
                except WorkerDiedError:
                    if attempt == ATTEMPTS or self._abandoned:
                        raise
        finally:
            self._idle.put(worker)
        raise AssertionError("unreachable")

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        for worker in self._workers:
            worker.stop()

    def abandon(self) -> None:
        self._abandoned = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.stop()


class _Worker:
    """A process that does one call at a time, started when there is one to do."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None

    def call(self, fn: Callable[..., T], args: Any, kwargs: Any) -> T:
        if self.process is None:
            self._start()
        try:
            self.pipe.send((fn, args, kwargs))
            done, value = self.pipe.recv()
        except (EOFError, OSError):
            raise WorkerDiedError(f"the process that worked on it {self._end()}") from None
        if done:
            return value  # type: ignore[no-any-return]
        raise value

    def stop(self) -> None:
        if self.process is not None:
            process, self.process = self.process, None
            process.terminate()
            process.wait()

    def _start(self) -> None:
        self.pipe, end = Pipe()
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        code = f"from pipeline.engines import serve; serve({end.fileno()})"
        self.process = subprocess.Popen(  # not a fork: the threads of libraries do not survive one
            [sys.executable, "-c", code],
            pass_fds=[end.fileno()],
            env={**dict.fromkeys(ONE_THREAD, "1"), **os.environ, "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL,
            stdout=2,  # results are the main process's business
            start_new_session=True,  # and so is Ctrl-C
        )
        end.close()

    def _end(self) -> str:
        """What the dead process died of, in words."""
        process, self.process = self.process, None
        if process is None:
            return "was stopped"
        code = process.wait()
        if code >= 0:
            return f"ended with status {code}"
        name = signal.Signals(-code).name
        memory = ", likely for want of memory" if name == "SIGKILL" else ""
        return f"was killed by {name}{memory}"


def serve(descriptor: int) -> None:
    """Do the calls that come through a pipe, until it ends."""
    threading.Thread(target=_follow, args=(os.getppid(),), daemon=True).start()
    pipe = Connection(descriptor)
    with suppress(EOFError, OSError):  # the pipe's end
        while True:
            pipe.send(_answer(pipe))


def _answer(pipe: Connection) -> tuple[bool, Any]:
    """Whether the next call went well, and its value or what it raised."""
    try:
        fn, args, kwargs = pipe.recv()
    except EOFError:
        raise
    except Exception as error:  # what was sent cannot be had here
        return False, DynoscopeError(f"a worker cannot load its task: {type(error).__name__}: {error}")
    try:
        return True, fn(*args, **kwargs)
    except Exception as error:
        return False, error


def _follow(parent: int) -> None:
    """Leave soon after the parent has gone: what it would have noted of this log, nobody does."""
    while os.getppid() == parent:
        time.sleep(0.1)
    os._exit(1)
