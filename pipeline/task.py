"""One log of a batch: from its file to its folder, in whatever process it is done.

A task carries all it needs, its detector and map too. What goes wrong with a log becomes its row of the
summary; what it has written by then is taken away.
"""

from __future__ import annotations

import json
import pickle
import re
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

from ingest import read_log
from ingest.blocks import in_step
from ingest.errors import DynoscopeError, LogError
from ingest.files import read_blocks, read_header, sha256, url_of
from ingest.log import Log
from ingest.maps import NameMap
from ingest.quality import Quality
from ingest.remote import download, file_name, hidden
from ingest.report import quality, with_quality
from pipeline.cache import Cache
from pipeline.describing import about
from pipeline.detector import Detector, restore
from pipeline.diagnosing import diagnose
from pipeline.digest import digest
from pipeline.files import draft_folder
from pipeline.manifest import build_manifest, run_key
from pipeline.outputs import (
    ANNOTATED,
    MANIFEST,
    SAMPLES,
    SHOWN,
    TIMELINE,
    VERDICT,
    put,
    run_folder,
    to_json,
    write_run,
)
from pipeline.remote_out import fetch_folder, send_files
from pipeline.streaming import diagnose_parts
from pipeline.summary import Row, verdict_row

Facts = dict[str, Any]
WHOLE_BYTES = 64 << 20  # larger files are diagnosed in parts
IN_PARTS = "in_parts"  # of a manifest


@dataclass(frozen=True, kw_only=True)
class Task:
    """A log to diagnose into ``folder``, which gets its ``name``.

    ``detector`` is what :func:`pack` made of one, unpacked once in a process. ``vehicle``: whose log it is
    where the log itself does not know.
    """

    path: Path
    name: str
    folder: Path
    detector: bytes
    url: str | None = None  # where ``path`` was fetched from
    send_to: str | None = None  # the URL that ``folder`` is to be copied to
    name_map: NameMap | None = None
    map_digest: str | None = None
    vehicle: str | None = None
    timeline: bool = True
    force: bool = False
    cache: Path | None = None
    debug: bool = False  # show the traceback of a log that failed


def pack(detector: Detector) -> bytes:
    """``detector`` as bytes for :class:`Task`: its record and arrays, no code."""
    return pickle.dumps((dict(detector.record), detector.arrays))


@lru_cache(4)
def _unpacked(packed: bytes) -> Detector:
    return restore(*pickle.loads(packed))


def run_task(task: Task) -> Row:
    """Diagnose a log unless that has been done; its row of the summary, whatever happens."""
    detector = _unpacked(task.detector)
    with TemporaryDirectory(prefix="dynoscope-") as folder:
        try:
            row = _diagnosed(_here(task, Path(folder)), detector)
        except Exception as error:  # whatever it is, the other logs are not to suffer
            if task.debug:
                traceback.print_exception(error)
            row = failure(task, error)
    return row | {"recipe": detector.recipe.name, "detector": detector.key}


def _here(task: Task, folder: Path) -> Task:
    """The task on this machine: a log behind a URL is fetched, an output folder behind one is made here."""
    url, out = url_of(task.path), url_of(task.folder)
    if url is not None:
        task = replace(task, path=download(url, folder), url=url)
    if out is not None:
        task = replace(task, folder=folder / "out" / task.name, send_to=out)
        fetch_folder(out, task.folder, (MANIFEST, VERDICT))
    return task


def failure(task: Task, error: Exception) -> Row:
    """The row of a log that failed; it says nothing of where the log lay."""
    reason = str(error) if isinstance(error, DynoscopeError) else f"{type(error).__name__}: {error}"
    for place in (url_of(task.path), str(task.path)):
        reason = reason.replace(hidden(place), file_name(place)) if place else reason
    reason = re.sub(rf"{re.escape(gettempdir())}/dynoscope-[^/]+/", "", reason)  # where a fetched log lay
    return {"log": task.name, "status": "failed", "reason": reason, "vehicle": task.vehicle}


def done(task: Task) -> bool:
    """Whether the log has been diagnosed by the same detector, and nothing is missing."""
    with TemporaryDirectory(prefix="dynoscope-") as folder:
        task = _here(task, Path(folder))
        if not task.path.is_file():
            return False
        return _row(task, _key(task, sha256(task.path), _unpacked(task.detector))) is not None


def _diagnosed(task: Task, detector: Detector) -> Row:
    began = time.perf_counter()
    if not task.path.is_file():
        what = "a folder without logs" if task.path.is_dir() else "there is no such file"
        raise LogError(f"{task.path}: {what}")
    content = sha256(task.path)
    key = _key(task, content, detector)
    if not task.force and (row := _row(task, key)):
        return row
    facts = {"sha256": content, "path": hidden(task.url or str(task.path))}
    if task.cache and not task.force and (row := _kept(task, key)):
        _send(task)
        return row
    if task.path.stat().st_size > WHOLE_BYTES:
        manifest = _in_parts(task, detector, key, facts, began)
    else:
        manifest = _whole(task, detector, key, facts, began)
    _send(task)
    if task.cache:
        Cache(task.cache).keep_run(_run_key(task, key), task.folder)
    verdict = json.loads((task.folder / VERDICT).read_text(encoding="utf-8"))
    return _complete(task, verdict, manifest)


def _send(task: Task) -> None:
    if task.send_to:
        send_files(list(task.folder.iterdir()), task.send_to, last=MANIFEST)


def _whole(task: Task, detector: Detector, key: str, facts: Facts, began: float) -> Facts:
    """Diagnose a log in memory; its manifest."""
    log = _log(task, facts["sha256"])
    found = Quality()
    found.add(log)
    log = with_quality(replace(log, name=task.name, facts={**log.facts, **facts}), found)
    diagnosis = diagnose(log, detector, quality=quality(log, found))
    manifest = build_manifest(log, detector, key, _times(began))
    write_run(diagnosis, task.folder, manifest, timeline=task.timeline)
    return manifest


def _log(task: Task, content: str) -> Log:
    """The log, from the cache if there is one and it is of use: ours in Parquet is as quick to read."""
    read = partial(read_log, task.path, task.name_map, content=content)
    if task.cache is None or task.path.suffix == ".parquet":
        return read()
    return Cache(task.cache).log(content, task.map_digest, read)


def _kept(task: Task, key: str) -> Row | None:
    """The row of a run that the cache has, now in the task's folder; its manifest says where it was made."""
    assert task.cache is not None
    cache, kept = Cache(task.cache), _run_key(task, key)
    with draft_folder(task.folder) as draft:
        if not cache.fetch_run(kept, draft):
            return None
        if row := _row(replace(task, folder=draft), key):
            put(draft, task.folder)
            return row
    cache.forget_run(kept)
    return None


def _run_key(task: Task, key: str) -> str:
    """What a run's files depend on beside its key: the name stands in them, and there may be no timeline."""
    return digest("run", key, task.name, task.timeline)


def _in_parts(task: Task, detector: Detector, key: str, facts: Facts, began: float) -> Facts:
    """Diagnose a log that is too large for that; its manifest, which says so."""
    counts = read_header(task.path, task.name_map).facts.get("rows")

    def parts() -> Iterator[Log]:
        return in_step(read_blocks(task.path, task.name_map, content=facts["sha256"]), counts)

    with run_folder(task.folder) as draft:
        log, duration = diagnose_parts(parts, detector, task.name, facts, draft, timeline=task.timeline)
        made = build_manifest(log, detector, key, _times(began), duration)
        manifest = {**made, IN_PARTS: True, SHOWN: {"about": about(detector).to_json()}}
        (draft / MANIFEST).write_text(to_json(manifest), encoding="utf-8")
    return manifest


def _times(began: float) -> dict[str, float | str]:
    """What of a run depends on when and how fast it was made; seconds without writing."""
    started = datetime.now(UTC).isoformat(timespec="seconds")
    return {"started": started, "seconds": round(time.perf_counter() - began, 3)}


def _key(task: Task, content: str, detector: Detector) -> str:
    return run_key(content, detector, {"map": task.map_digest})


def _row(task: Task, key: str) -> Row | None:
    """The row of a log that has been run with the same ``key``, all its files in place; else None."""
    try:
        manifest, verdict = (
            json.loads((task.folder / file).read_text(encoding="utf-8")) for file in (MANIFEST, VERDICT)
        )
        timeline = [TIMELINE] if task.timeline else []
        there = all((task.folder / file).is_file() for file in (SAMPLES, ANNOTATED, *timeline))
        return _complete(task, verdict, manifest) if there and manifest["key"] == key else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError):  # damaged: run it again
        return None


def _complete(task: Task, verdict: Mapping[str, Any], manifest: Mapping[str, Any]) -> Row:
    row = verdict_row(task.name, verdict, manifest)
    return row | {"vehicle": row["vehicle"] or task.vehicle}
