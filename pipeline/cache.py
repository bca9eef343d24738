"""A cache of what is dear to make twice: read logs, and finished runs.

Every entry is a file or folder named by the digest of all it depends on, and appears whole or not at all, so
that any number of processes may share a cache. Reading marks an entry as used; what was not used for longest
is pruned first. Damaged entries are made again.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ingest import read_log, write_log
from ingest.errors import LogError, StoreError
from ingest.log import Log
from pipeline.digest import digest
from pipeline.files import draft_folder, sweep

FORMAT = 1
LOGS, RUNS = "logs", "runs"


@dataclass(frozen=True)
class Entry:
    """One thing that is kept."""

    path: Path
    bytes: int
    used: float  # s since the epoch


@dataclass(frozen=True)
class Cache:
    """A cache in ``folder``: ``logs/<key>.parquet`` and ``runs/<key>/``."""

    folder: Path

    def check(self) -> None:
        """Whether something can be kept.

        Raises:
            StoreError: the folder cannot be made or written.
        """
        try:
            for kind in (LOGS, RUNS):
                (self.folder / kind).mkdir(parents=True, exist_ok=True)
                sweep(self.folder / kind)
                with draft_folder(self.folder / kind / "probe"):
                    pass
        except OSError as error:
            raise self._problem(error) from None

    def log(self, sha256: str, map_digest: str | None, read: Callable[[], Log]) -> Log:
        """The log of a file with this digest, read with this map, from here or by ``read``, and then kept.

        Raises:
            LogError: what ``read`` raises.
            StoreError: it cannot be kept.
        """
        path = self.folder / LOGS / f"{digest('log', FORMAT, sha256, map_digest)}.parquet"
        with suppress(LogError):  # not there, or damaged
            log = read_log(path)
            _touch(path)
            return log
        log = read()
        try:
            write_log(log, path)
        except LogError as error:
            raise StoreError(f"cache {self.folder}: {error}; {_WAY_OUT}") from None
        return log

    def fetch_run(self, key: str, folder: Path) -> bool:
        """Whether a run with this key was kept; its files then are in ``folder``."""
        kept = self.folder / RUNS / key
        try:
            files = list(kept.iterdir())
            for file in files:
                _link(file, folder / file.name)
        except OSError:
            return False
        _touch(kept)
        return bool(files)

    def forget_run(self, key: str) -> None:
        """Remove a run that turned out to be damaged."""
        _remove(self.folder / RUNS / key)

    def keep_run(self, key: str, folder: Path) -> None:
        """Keep the files of a finished run.

        Raises:
            StoreError: they cannot be kept.
        """
        kept = self.folder / RUNS / key
        try:
            with draft_folder(kept) as draft:
                for file in folder.iterdir():
                    _link(file, draft / file.name)
                if not kept.exists():
                    draft.rename(kept)
        except OSError as error:
            if not kept.is_dir():  # else another process was faster
                raise self._problem(error) from None

    def entries(self) -> list[Entry]:
        """All that is kept, least recently used first."""
        found = [*self._of(LOGS, "*.parquet"), *self._of(RUNS, "*")]
        return sorted(found, key=lambda e: e.used)

    def _of(self, kind: str, pattern: str) -> Iterator[Entry]:
        for path in (self.folder / kind).glob(pattern):
            if not path.name.startswith("."):
                with suppress(OSError):  # pruned by another process
                    files = list(path.iterdir()) if path.is_dir() else [path]
                    yield Entry(path, sum(f.stat().st_size for f in files), path.stat().st_mtime)

    def prune(self, *, keep_bytes: int | None = None, older_than_s: float | None = None) -> list[Entry]:
        """Remove entries not used for ``older_than_s``, then the least recently used until ``keep_bytes``
        remain; all of them if neither is given. Returns what has gone."""
        entries = self.entries()
        total, now = sum(e.bytes for e in entries), time.time()
        gone = []
        for entry in entries:
            old = older_than_s is not None and now - entry.used > older_than_s
            large = keep_bytes is not None and total > keep_bytes
            if old or large or (older_than_s is None and keep_bytes is None):
                _remove(entry.path)
                total -= entry.bytes
                gone.append(entry)
        return gone

    def _problem(self, error: OSError) -> StoreError:
        return StoreError(f"cache {self.folder} cannot be written: {error.strerror or error}; {_WAY_OUT}")


_WAY_OUT = "make room with `dynoscope cache prune`, or run without --cache"


def default_folder() -> Path:
    """Where the cache is unless a folder is named."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "dynoscope"


def _link(file: Path, to: Path) -> None:
    """The same file under another name, or a copy on another file system; files are never changed."""
    try:
        os.link(file, to)
    except FileExistsError:
        raise
    except OSError:
        shutil.copyfile(file, to)


def _touch(path: Path) -> None:
    with suppress(OSError):  # a cache that can only be read is of use too
        os.utime(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
