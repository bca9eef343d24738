"""Threads beside the interpreter's own, for what runs outside it: packing, unpacking, digests.

A process that is granted one thread (``POLARS_MAX_THREADS=1``, as the workers of a batch are) does that work
where it stands: as many processes as cores then get a core each.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Inline(Executor):
    """Everything where it stands, one after the other.

    >>> Inline().submit(max, 1, 2).result()
    2
    """

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def threads(count: int) -> Executor:
    """So many threads, or none of its own where the process is granted one."""
    return Inline() if os.environ.get("POLARS_MAX_THREADS") == "1" else ThreadPoolExecutor(count)
