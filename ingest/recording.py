"""Writing a log part by part, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import cast

import polars as pl

from ingest.blocks import join
from ingest.errors import LogError, did_you_mean
from ingest.log import Log
from ingest.readers import Recorder, Writer, reader

WRITERS = {".mcap": "mcap", ".parquet": "parquet", ".csv": "csv", ".mf4": "mdf"}
"""Suffix -> format, for those formats that can be written."""


@contextmanager
def recording(path: Path, first: Log) -> Iterator[Recorder]:
    """What writes a log like ``first`` to ``path`` part by part; the file appears once all is well.

    Raises:
        LogError: as :func:`write_log`.
    """
    if path.suffix.lower() not in WRITERS:
        raise LogError(f"{path}: cannot write {path.suffix!r} files; {did_you_mean(path.suffix, WRITERS)}")
    _check_types(first)
    module = reader(WRITERS[path.suffix.lower()])
    make = getattr(module, "Recorder", partial(_AtOnce, cast(Writer, module)))
    aside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with closing(make(aside, first)) as recorder:
            yield recorder
        aside.replace(path)
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)


@dataclass
class _AtOnce:
    """A recorder for a format that is written at once: it keeps the parts until then."""

    writer: Writer
    path: Path
    first: Log
    parts: list[Log] = field(default_factory=list)

    def add(self, part: Log) -> None:
        self.parts.append(part)

    def finish(self, whole: Log, attachments: Mapping[str, bytes]) -> None:
        log = join(self.parts)
        signals = whole.signals
        groups = {k: replace(g, signals={s: signals[s] for s in g.signals}) for k, g in log.groups.items()}
        self.writer.write(replace(whole, groups=groups), self.path)

    def close(self) -> None:
        self.parts.clear()


def _check_types(log: Log) -> None:
    for group in log.groups.values():
        for name, dtype in group.frame.schema.items():
            if not (dtype.is_integer() or dtype in (pl.Float32, pl.Float64, pl.Boolean, pl.String)):
                raise LogError(f"log {log.name!r}: {name!r} is {dtype}; expected numbers, Boolean or String")
            if "\0" in name:
                raise LogError(f"log {log.name!r}: {name!r} cannot be written: a zero character in a name")
