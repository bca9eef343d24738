"""From files to logs: the data model, readers, name maps, units, simulators, writers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ingest.files import read_log, write_log

__all__ = ["read_log", "write_log"]


def __getattr__(name: str) -> Any:  # lazy: the command line must answer --help without polars
    if name in __all__:
        from ingest import files

        return getattr(files, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
