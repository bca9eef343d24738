"""The formats that can be read: one module each, found by what is in the file.

A format is a module with three small functions, and more where a format can do more::

    is_mine(path, head)   whether a file that begins with the bytes ``head`` is of this format
    header(path, names)   its channels without their rows; the fact "rows" counts them by group where known
    read(path, names)     all of it
    blocks(path, names)   all of it in parts of consecutive rows; the last part has the facts of the whole
    Recorder(path, first) writes a log part by part: ``add(part)``, then ``finish(whole, attachments)``
    write(log, path)      writes a log at once (formats without a Recorder)

``names`` is the user's map; a format needs of it at most which column is time. Renaming and units are done in
one place, :func:`ingest.files.read_log`. A new format is one file here, one line in the table, and its tests.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, Protocol, cast

from ingest.errors import LogError
from ingest.log import Log
from ingest.maps import NameMap

FORMATS = {
    "mcap": (".mcap",),
    "parquet": (".parquet",),
    "arrow": (".arrow", ".feather", ".ipc"),
    "mdf": (".mf4", ".mdf", ".mf3", ".dat"),
    "tdms": (".tdms",),
    "mat": (".mat",),
    "can": (".blf", ".asc"),
    "csv": (".csv", ".tsv"),
}
"""Module -> suffixes that make a file in a folder a log. The modules are asked in this order."""


class Recording(NamedTuple):
    """What a reader found. ``ours``: written by dynoscope, so names, units and facts are as they were.

    ``share`` of the file that has been read.
    """

    log: Log
    ours: bool = False
    share: float = 1.0


class Reader(Protocol):
    """What every module named in :data:`FORMATS` has."""

    def is_mine(self, path: Path, head: bytes) -> bool: ...
    def header(self, path: Path, names: NameMap) -> Recording: ...
    def read(self, path: Path, names: NameMap) -> Recording: ...


class Streamer(Protocol):
    """A format that can be read in parts."""

    def blocks(self, path: Path, names: NameMap) -> Iterator[Recording]: ...


class Recorder(Protocol):
    """Writes one file, part by part."""

    def add(self, part: Log) -> None: ...
    def finish(self, whole: Log, attachments: Mapping[str, bytes]) -> None: ...
    def close(self) -> None: ...


class Writer(Protocol):
    """A format that can be written at once."""

    def write(self, log: Log, path: Path) -> None: ...


def reader(name: str) -> Reader:
    """The module that reads a format; imported only now, since some are heavy."""
    return cast(Reader, import_module(f"ingest.readers.{name}"))


def need(module: str, extra: str) -> ModuleType:
    """A library that only some formats need.

    Raises:
        LogError: it is not installed; the message says how to get it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise LogError(
            f"this format needs {error.name}: pip install 'dynoscope[{extra}]' (or 'dynoscope[all]')"
        ) from error


def check_declared(path: Path, rows: int, columns: int) -> None:
    """Refuses what a file claims to hold where no memory could: a damaged or malicious header.

    Raises:
        LogError: it is more than this machine's memory.
    """
    need, memory = rows * columns * 8, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if need > memory:
        raise LogError(
            f"{path}: declares {rows} rows of {columns} channels, {need / 1e9:.0f} GB unpacked, in a file of "
            f"{path.stat().st_size / 1e6:.1f} MB; this machine has {memory / 1e9:.0f} GB: "
            "the file is damaged, or must be split"
        )
