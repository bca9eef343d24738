"""A process that is granted one thread takes no other."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from ingest.threads import Inline, threads


def test_no_thread_of_its_own_where_one_is_granted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POLARS_MAX_THREADS", "1")
    with threads(2) as pool:
        assert pool.submit(threading.get_ident).result() == threading.get_ident()
    monkeypatch.delenv("POLARS_MAX_THREADS")
    with threads(2) as pool:
        assert isinstance(pool, ThreadPoolExecutor)
        assert pool.submit(threading.get_ident).result() != threading.get_ident()


def test_what_fails_fails_when_it_is_asked_for() -> None:
    future = Inline().submit(int, "x")
    with pytest.raises(ValueError, match="invalid literal"):
        future.result()
