"""Logs behind URLs: found and fetched through ``pyarrow.fs``, or ``fsspec`` where that knows the scheme.

A file is fetched whole into a temporary folder that goes when the program ends: readers seek, and a log is
read more than once.
"""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Sequence
from fnmatch import fnmatch
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

from ingest.errors import LogError

_SIMPLE = ("s3", "gs", "gcs", "hdfs", "abfs", "abfss")  # schemes of pyarrow's own file systems
_PIECE = 1 << 22


def fetch(url: str, suffixes: Sequence[str]) -> list[Path]:
    """Local copies of what a URL means: a file, a folder's files with one of ``suffixes``, or a glob's.

    Raises:
        LogError: no such address, nothing there, no access, or a library for the scheme is missing.
    """
    import pyarrow as pa
    from pyarrow import fs as files

    scheme = url.partition("://")[0].lower()
    where, pattern = _parted(url)
    try:
        system, base = _file_system(where, scheme, files)
        info = system.get_file_info(base)
        if info.type == files.FileType.File:
            found = [base]
        else:
            inside = system.get_file_info(files.FileSelector(base, recursive="**" in pattern))
            plain = sorted(i.path for i in inside if i.type == files.FileType.File)
            found = [p for p in plain if _fits(p, base, pattern, suffixes)]
        if not found:
            wanted = f"fits {pattern}" if pattern else f"ends in {' '.join(suffixes)}"
            raise LogError(f"{_hidden(url)}: no file there {wanted}")
        return [_copy(system, path) for path in found]
    except LogError:
        raise
    except (OSError, ValueError, pa.ArrowException, ImportError) as error:
        raise LogError(f"{_hidden(url)} cannot be read: {str(error).splitlines()[0]}") from error


def _parted(url: str) -> tuple[str, str]:
    """Folder and pattern of a URL with a glob; of another the URL and nothing. Options follow ``?``."""
    address, mark, options = url.partition("?")
    parts = address.split("/")
    first = next((i for i, p in enumerate(parts) if "*" in p or "[" in p), None)
    if first is None:
        return url, ""
    return "/".join(parts[:first]) + mark + options, "/".join(parts[first:])


def _file_system(url: str, scheme: str, files: Any) -> tuple[Any, str]:
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


def _copy(system: Any, path: str) -> Path:
    """A local copy, in a folder of its own, so that names stay as they are."""
    target = Path(tempfile.mkdtemp(dir=_folder())) / (PurePosixPath(path.partition("?")[0]).name or "log")
    with system.open_input_stream(path) as source, target.open("wb") as copy:
        shutil.copyfileobj(source, copy, _PIECE)
    return target


@cache
def _folder() -> str:
    folder = tempfile.mkdtemp(prefix="dynoscope-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _hidden(url: str) -> str:
    """The URL without a password in it."""
    scheme, mark, rest = url.partition("://")
    account, at, place = rest.partition("@")
    return f"{scheme}{mark}…@{place}" if at and "/" not in account else url
