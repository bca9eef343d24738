"""The way in and out: find logs, read any supported file as a :class:`Log`, write one whole or not at all."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from functools import partial
from glob import glob, has_magic
from pathlib import Path
from typing import cast
from urllib.parse import unquote, urlsplit

from ingest.errors import LogError
from ingest.log import Log
from ingest.mapping import apply_map
from ingest.maps import NameMap, load_map
from ingest.readers import FORMATS, Reader, Recording, Streamer, reader
from ingest.recording import recording
from ingest.remote import fetch, file_name, listing
from ingest.threads import threads

_SUFFIXES = tuple(s for known in FORMATS.values() for s in known)


def read_log(path: str | Path, map: NameMap | str | Path | None = None, *, content: str | None = None) -> Log:
    """Reads a log of any supported format, found by its content, in canonical names and units.

    A file that :func:`write_log` wrote comes back as it was; of any other the facts ``file``, ``format`` and
    ``sha256`` are noted. ``content``: the file's sha256, where it is known already.

    Raises:
        LogError: no such file, no known format, damaged, or without samples.
        MapError: the map is wrong.
        UnitError: a canonical signal is in a unit that cannot be converted.
    """
    path, names = _local(path), _names(map)
    with _readable(path), threads(1) as pool:
        name, module = _format(path)
        digest = _digest(pool, path, module, content)
        found = _with_source(module.read(path, names), path, name, digest)
    return _canonical(found, names, map is not None)


def read_blocks(
    path: str | Path,
    map: NameMap | str | Path | None = None,
    progress: Callable[[float], None] | None = None,
    *,
    content: str | None = None,
) -> Iterator[Log]:
    """Reads a log in parts of consecutive rows (see :mod:`ingest.blocks`), each as :func:`read_log` would.

    Formats that cannot be read in parts come as one. ``progress`` is told the share that has been read.

    Raises:
        LogError, MapError, UnitError: as :func:`read_log`.
    """
    path, names = _local(path), _names(map)
    with _readable(path), threads(1) as pool:
        name, module = _format(path)
        digest = _digest(pool, path, module, content)
        parts = (
            cast(Streamer, module).blocks(path, names)
            if hasattr(module, "blocks")
            else [module.read(path, names)]
        )
        for part in parts:
            if progress:
                progress(part.share)
            yield _canonical(_with_source(part, path, name, digest), names, map is not None)


def read_header(path: str | Path, map: NameMap | str | Path | None = None) -> Log:
    """The log without its rows, from as little of the file as its format allows.

    The fact ``rows`` counts the rows by group where the format knows.
    """
    path, names = _local(path), _names(map)
    with _readable(path):
        found = _format(path)[1].header(path, names)
    return _canonical(found, names, map is not None)


def write_log(log: Log, path: str | Path, attachments: Mapping[str, bytes] | None = None) -> Path:
    """Writes a log; the suffix picks the format. The file appears whole or not at all.

    MCAP and Parquet keep everything: values, types, signals, events, facts, the order of the groups, the
    name. CSV keeps all but the types. MCAP takes ``attachments`` (file name -> content) along.

    Raises:
        LogError: no such format, a type or fact that a log cannot hold, or the file cannot be written.
    """
    path = Path(path)
    with recording(path, log) as recorder:
        recorder.add(log)
        recorder.finish(log, attachments or {})
    return path


def find_logs(patterns: Iterable[str | Path], *, remote: bool = False) -> list[Path]:
    """The files meant by files, folders, globs, URLs and ``@list.txt`` (one of these a line).

    Of a folder its own files with a suffix of a known format count, in order of their names. Each file counts
    once, where it is meant first. Those behind URLs are fetched, unless they are to stay ``remote``. What
    means no file stands in the result as it is, so that reading it fails and the others are read.

    Raises:
        LogError: none of them means a file; all are listed.
    """
    found: dict[Path, None] = {}
    mistakes: list[str] = []
    some = False
    for pattern in patterns:
        meant = _meant(str(pattern), mistakes, remote)
        some = some or bool(meant)
        found |= dict.fromkeys(meant or [Path(pattern)])
    if not some:
        raise LogError("\n".join(mistakes) or "no logs were named")
    return list(found)


def unique_stems(paths: Sequence[Path]) -> list[str]:
    """A folder name for each log: its stem, and for equal stems ``<stem>-<8 hex digits of its sha256>``."""
    names = [Path(file_name(p)).stem for p in paths]
    count = Counter(names)
    twice = [
        count[n] > 1 and (p.is_file() or url_of(p) is not None) for p, n in zip(paths, names, strict=True)
    ]
    return [f"{n}-{sha256(_local(p))[:8]}" if t else n for p, n, t in zip(paths, names, twice, strict=True)]


def group_file(group: str) -> str:
    """The name of a group's own Parquet file; characters that a file name cannot have are escaped.

    >>> group_file("ecu"), group_file("a/b")
    ('ecu.parquet', 'a%2Fb.parquet')
    """
    return re.sub(r'^\.|[\x00-\x1f/\\:*?"<>|%]', lambda m: f"%{ord(m[0]):02X}", group) + ".parquet"


def sha256(path: Path) -> str:
    """Digest of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def url_of(path: str | Path) -> str | None:
    """The URL that a path stands for, if it does: ``Path`` makes one slash of two.

    >>> url_of(Path("s3://bench/a.mcap"))
    's3://bench/a.mcap'
    """
    url = re.fullmatch(r"([A-Za-z][A-Za-z0-9+.-]+):/{1,2}(.+)", str(path), re.DOTALL)
    return None if url is None or Path(path).exists() else f"{url[1]}://{url[2]}"


def _local(path: str | Path) -> Path:
    """The file itself, or a copy of what a URL means."""
    url = url_of(path)
    if url is None:
        return Path(path)
    if url.startswith("file://"):
        return Path("/" + url.removeprefix("file://").lstrip("/"))
    return fetch(url, _SUFFIXES)[0]


def _names(map: NameMap | str | Path | None) -> NameMap:
    return map if isinstance(map, NameMap) else NameMap() if map is None else load_map(map)


def _digest(pool: Executor, path: Path, module: Reader, content: str | None) -> Callable[[], str]:
    """The file's digest, if it is not known made while it is read; where it may be one of ours, only when it
    is asked for."""
    if content is not None:
        return lambda: content
    return partial(sha256, path) if hasattr(module, "Recorder") else pool.submit(sha256, path).result


def _with_source(found: Recording, path: Path, name: str, digest: Callable[[], str]) -> Recording:
    """Notes the file and its digest, unless the log is one of ours, which knows its source."""
    if found.ours:
        return found
    source = {"file": path.name, "format": name, "sha256": digest()}
    return found._replace(log=replace(found.log, facts={**source, **found.log.facts}))


def _canonical(found: Recording, names: NameMap, mapped: bool) -> Log:
    return found.log if found.ours and not mapped else apply_map(found.log, names)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        if not path.exists():
            raise LogError(_missing(path))
        if path.is_dir():
            raise LogError(f"{path} is a folder without logs in it; expected a file")
        yield
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror or error}") from error


def _format(path: Path) -> tuple[str, Reader]:
    with path.open("rb") as file:
        head = file.read(4096)
    if not head:
        raise LogError(f"{path}: the file is empty")
    for name in FORMATS:
        module = reader(name)
        if module.is_mine(path, head):
            return name, module
    raise LogError(
        f"{path}: not a log of a known format ({', '.join(FORMATS)}); it begins with {head[:12]!r}"
    )


def _meant(pattern: str, mistakes: list[str], remote: bool) -> list[Path]:
    url = urlsplit(pattern)
    if len(url.scheme) > 1 and "//" in pattern:
        if url.scheme == "file":
            return _meant(unquote(url.path), mistakes, remote)
        try:
            return [Path(u) for u in listing(pattern, _SUFFIXES)] if remote else fetch(pattern, _SUFFIXES)
        except LogError as error:
            mistakes.append(str(error))
            return []
    if pattern.startswith("@") and not Path(pattern).exists():
        return _listed(Path(pattern[1:]), mistakes, remote)
    path = Path(pattern)
    if path.is_file():
        return [path]
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES and p.name[0] != ".")
        if not files:
            mistakes.append(
                f"{pattern}: no logs in this folder; expected files ending in {' '.join(_SUFFIXES)}"
            )
        return files
    if has_magic(pattern):
        files = sorted(p for p in map(Path, glob(pattern, recursive=True)) if p.is_file())
        if not files:
            mistakes.append(f"{pattern}: no file fits this pattern")
        return files
    mistakes.append(_missing(path))
    return []


def _missing(path: Path) -> str:
    if not path.parent.is_dir():
        return f"{path}: there is no folder {path.parent}"
    near = get_close_matches(path.name, [p.name for p in path.parent.iterdir()])
    return f"{path}: there is no such file{f'; did you mean {near[0]}?' if near else ''}"


def _listed(path: Path, mistakes: list[str], remote: bool) -> list[Path]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        mistakes.append(f"@{path}: the list cannot be read: {error}")
        return []
    wanted = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not wanted:
        mistakes.append(f"@{path}: the list is empty")
    return [file for line in wanted for file in _meant(line, mistakes, remote)]
