"""Logs behind URLs: found and fetched through ``pyarrow.fs``, or ``fsspec`` where that knows the scheme.

A file is fetched whole into a temporary folder that goes when the program ends: readers seek, and a log is
read more than once.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from functools import cache
from multiprocessing.util import Finalize
from pathlib import Path, PurePosixPath
from typing import Any

from ingest.errors import LogError

_SIMPLE = ("s3", "gs", "gcs", "hdfs", "abfs", "abfss")  # schemes of pyarrow's own file systems
_PIECE = 1 << 22


def fetch(url: str, suffixes: Sequence[str]) -> list[Path]:
    """Local copies of what a URL means, see :func:`listing`; each in a folder of its own, so that names stay
    as they are.

    Raises:
        LogError: as :func:`listing`, or a file cannot be read.
    """
    return [download(found, Path(tempfile.mkdtemp(dir=_folder()))) for found in listing(url, suffixes)]


def listing(url: str, suffixes: Sequence[str]) -> list[str]:
    """The URLs of the files that a URL means: itself, a folder's files with one of ``suffixes``, or a glob's.

    Raises:
        LogError: no such address, nothing there, no access, or a library for the scheme is missing.
    """
    from pyarrow import fs as files

    scheme, _, rest = url.partition("://")
    where, pattern = _parted(url)
    options = rest.partition("?")[1] + rest.partition("?")[2]
    with _readable(url):
        system, base = file_system(where)
        info = system.get_file_info(base)
        if info.type == files.FileType.File:
            return [url]
        inside = system.get_file_info(files.FileSelector(base, recursive="**" in pattern))
        plain = sorted(i.path for i in inside if i.type == files.FileType.File)
        found = [p for p in plain if _fits(p, base, pattern, suffixes)]
        if not found:
            wanted = f"fits {pattern}" if pattern else f"ends in {' '.join(suffixes)}"
            raise LogError(f"{hidden(url)}: no file there {wanted}")
        return [f"{scheme}://{path.lstrip('/')}{options}" for path in found]


def download(url: str, folder: Path) -> Path:
    """A copy of a file in ``folder``, under its own name.

    Raises:
        LogError: it cannot be read.
    """
    with _readable(url):
        system, path = file_system(url)
        target = folder / file_name(url)
        with system.open_input_stream(path) as source, target.open("wb") as copy:
            shutil.copyfileobj(source, copy, _PIECE)
        return target


def file_name(url: str | Path) -> str:
    """The name of the file that a URL means, without options.

    >>> file_name("s3://bench/run/a.mcap?region=x")
    'a.mcap'
    """
    return PurePosixPath(str(url).partition("?")[0]).name or "log"


@contextmanager
def _readable(url: str) -> Iterator[None]:
    import pyarrow as pa

    try:
        yield
    except LogError:
        raise
    except (OSError, ValueError, pa.ArrowException, ImportError) as error:
        raise LogError(f"{hidden(url)} cannot be read: {str(error).splitlines()[0]}") from error


def _parted(url: str) -> tuple[str, str]:
    """Folder and pattern of a URL with a glob; of another the URL and nothing. Options follow ``?``."""
    address, mark, options = url.partition("?")
    parts = address.split("/")
    first = next((i for i, p in enumerate(parts) if "*" in p or "[" in p), None)
    if first is None:
        return url, ""
    return "/".join(parts[:first]) + mark + options, "/".join(parts[first:])


def file_system(url: str) -> tuple[Any, str]:
    """The file system of a URL as pyarrow's, and the path in it."""
    from pyarrow import fs as files

    scheme = url.partition("://")[0].lower()
    if scheme in _SIMPLE:
        return tuple(files.FileSystem.from_uri(url))
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise LogError(f"{scheme} addresses need fsspec: pip install 'dynoscope[cloud]'") from error
    system, path = url_to_fs(url)
    return files.PyFileSystem(files.FSSpecHandler(system)), path


def _fits(path: str, base: str, pattern: str, suffixes: Sequence[str]) -> bool:
    name = PurePosixPath(path)
    if name.name.startswith("."):
        return False
    if not pattern:
        return name.suffix.lower() in suffixes
    return fnmatch(path[len(base.rstrip("/")) + 1 :], pattern)


@cache
def _folder() -> str:
    folder = tempfile.mkdtemp(prefix="dynoscope-")
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=0)  # also at the end of a worker process
    return folder


def hidden(url: str) -> str:
    """The URL without a password in it."""
    scheme, mark, rest = url.partition("://")
    account, at, place = rest.partition("@")
    return f"{scheme}{mark}…@{place}" if at and "/" not in account else url
