"""A dask cluster as an engine: scheduler and workers are started by dask's own commands, on any machines.

A task carries its detector, map and settings; a recipe's own modules are sent along. Inputs and outputs must
lie where every worker finds them under the same name. A worker that dies loses nothing: the scheduler gives
its task to another.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError, Executor, Future
from functools import partial
from importlib import import_module
from importlib.metadata import version
from typing import Any, ParamSpec, TypeVar

from ingest.errors import DynoscopeError
from pipeline.engines import WorkerDiedError

P = ParamSpec("P")
T = TypeVar("T")
TIMEOUT_S = 10


class Cluster(Executor):
    """The workers of the scheduler at ``address``; ``modules`` are sent to them.

    Raises:
        DynoscopeError: no such scheduler, no workers, or workers with another version of dynoscope.
    """

    def __init__(self, address: str, modules: Iterable[str] = ()) -> None:
        try:
            distributed = import_module("distributed")
        except ImportError:
            raise DynoscopeError("--scheduler needs dask: pip install 'dynoscope[distributed]'") from None
        try:
            self._client = distributed.Client(address, timeout=TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise DynoscopeError(
                f"--scheduler {address}: no scheduler answers ({error or type(error).__name__}); "
                "start one with: dask scheduler"
            ) from None
        self.address = address
        try:
            self._check_workers()
            for module in modules:
                self._client.upload_file(sys.modules[module].__file__)
        except BaseException:
            self._client.close()
            raise
        self._executor = self._client.get_executor(pure=False)  # equal logs are different tasks

    def _check_workers(self) -> None:
        try:
            self._client.wait_for_workers(1, timeout=TIMEOUT_S)
        except TimeoutError:
            raise DynoscopeError(
                f"--scheduler {self.address}: it has no workers; start some with: dask worker {self.address}"
            ) from None
        found = self._client.run(_version)
        other = {worker: v for worker, v in found.items() if v != _version()}
        if other:
            listed = ", ".join(f"{v or 'none'} at {worker}" for worker, v in sorted(other.items()))
            raise DynoscopeError(
                f"--scheduler {self.address}: this is dynoscope {_version()}, its workers have {listed}; "
                "install the same everywhere"
            )

    @property
    def window(self) -> int:
        """Workers may come and go."""
        return 2 * max(1, sum(int(n) for n in self._client.ncores().values()))

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        outer: Future[T] = Future()
        self._executor.submit(fn, *args, **kwargs).add_done_callback(partial(_pass_on, self.address, outer))
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._executor.shutdown(wait)
        self._client.close()

    def abandon(self) -> None:
        self._executor.shutdown(wait=False)  # cancels what has not begun
        self._client.close()


def _version() -> str | None:
    """Of dynoscope, where this runs."""
    try:
        return version("dynoscope")
    except ImportError:
        return None


def _pass_on(address: str, outer: Future[Any], inner: Future[Any]) -> None:
    """The outcome in our own words: dask's name addresses, and the summary does not depend on where."""
    try:
        outer.set_result(inner.result())
    except import_module("distributed").KilledWorker:
        outer.set_exception(WorkerDiedError("every process that worked on it died"))
    except CancelledError:
        outer.set_exception(ConnectionError(f"the scheduler {address} has gone; run the same again to go on"))
    except Exception as error:
        outer.set_exception(error)
