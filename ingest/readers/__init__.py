"""The formats that can be read: one module each, found by what is in the file.

A format is a module with three small functions, and a fourth where we also write it::

    is_mine(path, head)   whether a file that begins with the bytes ``head`` is of this format
    header(path, names)   its channels without their rows; the fact "rows" counts them by group where known
    read(path, names)     all of it
    write(log, path)      a log as a new file at ``path``

``names`` is the user's map; a format needs of it at most which column is time. Renaming and units are done in
one place, :func:`ingest.files.read_log`. A new format is one file here, one line in the table, and its tests.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import NamedTuple, Protocol, cast

from ingest.log import Log
from ingest.maps import NameMap

FORMATS = {
    "mcap": (".mcap",),
    "parquet": (".parquet",),
    "csv": (".csv", ".tsv"),
}
"""Module -> suffixes that make a file in a folder a log. The modules are asked in this order."""


class Recording(NamedTuple):
    """What a reader found. ``ours``: written by dynoscope, so names, units and facts are as they were."""

    log: Log
    ours: bool = False


class Reader(Protocol):
    """What every module named in :data:`FORMATS` has; those we also write have ``write`` too."""

    def is_mine(self, path: Path, head: bytes) -> bool: ...
    def header(self, path: Path, names: NameMap) -> Recording: ...
    def read(self, path: Path, names: NameMap) -> Recording: ...


class Writer(Protocol):
    """A format that can be written."""

    def write(self, log: Log, path: Path) -> None: ...


def reader(name: str) -> Reader:
    """The module that reads a format; imported only now, since some are heavy."""
    return cast(Reader, import_module(f"ingest.readers.{name}"))
