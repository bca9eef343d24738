"""Any log as MCAP and Parquet, part by part, so that its size does not matter."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from ingest.blocks import follow
from ingest.errors import LogError
from ingest.files import group_file
from ingest.log import Log
from ingest.quality import Quality
from ingest.readers import Recorder
from ingest.recording import recording
from ingest.report import describe, with_quality

REPORT = "report.json"


def convert(
    parts: Iterable[Log], out: Path, stem: str, attachments: Mapping[str, bytes] | None = None
) -> tuple[dict[str, Any], list[Path]]:
    """Writes ``out/<stem>.mcap``, ``out/<stem>/<group>.parquet`` and ``out/<stem>/report.json``.

    Both forms are written side by side while the next part is read. The report goes into the MCAP file too,
    beside the ``attachments``. Group files that an earlier conversion left and this one does not have are
    removed.

    Returns:
        The report, and the files.

    Raises:
        LogError, UnitError: what reading the parts raises, or a file cannot be written.
    """
    stream = iter(parts)
    first = next(stream)
    found = Quality()
    folder = out / stem
    files = {g: folder / group_file(g) for g in first.groups}
    before = _earlier(folder)
    with ExitStack() as stack:
        mcap = stack.enter_context(recording(out / f"{stem}.mcap", first))
        tables = {g: stack.enter_context(recording(p, _only(first, g))) for g, p in files.items()}
        whole = _write(chain([first], stream), mcap, tables, found)
        whole = with_quality(whole, found)
        report = describe(whole, found)
        text = json.dumps(report, indent=1, ensure_ascii=False).encode()
        mcap.finish(whole, {**(attachments or {}), REPORT: text})
        for group, table in tables.items():
            table.finish(_only(whole, group), {})
    draft = folder / f".{REPORT}"
    try:
        draft.write_bytes(text)
        draft.replace(folder / REPORT)
    except OSError as error:
        raise LogError(f"{folder / REPORT} cannot be written: {error.strerror or error}") from error
    for path in before - set(files.values()):
        path.unlink(missing_ok=True)
    return report, [out / f"{stem}.mcap", *files.values(), folder / REPORT]


def _write(parts: Iterator[Log], mcap: Recorder, tables: Mapping[str, Recorder], found: Quality) -> Log:
    """Writes all parts; returns what is known after the last."""
    whole: Log | None = None
    pending: list[Future[None]] = []
    with ThreadPoolExecutor(3) as pool:
        for part in parts:
            for job in pending:
                job.result()
            whole = part if whole is None else follow(whole, part)
            pending = [pool.submit(mcap.add, part), pool.submit(found.add, part)]
            pending.append(pool.submit(_add_tables, tables, part))
        for job in pending:
            job.result()
    assert whole is not None  # there is at least one part
    return follow(whole, whole)


def _add_tables(tables: Mapping[str, Recorder], part: Log) -> None:
    for group, table in tables.items():
        table.add(_only(part, group))


def _only(log: Log, group: str) -> Log:
    return replace(log, groups={group: log.groups[group]})


def _earlier(folder: Path) -> set[Path]:
    """The group files of an earlier conversion, as its report has them."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        groups = json.loads((folder / REPORT).read_bytes())["groups"]
        return {folder / group_file(g) for g in groups}
    return set()
