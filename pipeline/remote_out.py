"""An output folder behind a URL: made here, and copied there file by file.

An object store has no rename; what makes a run whole there is its manifest, which comes last and goes first.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ingest.errors import LogError
from ingest.remote import file_system, hidden

PIECE = 1 << 22


def fetch_folder(url: str, folder: Path, contents: Sequence[str]) -> None:
    """What lies behind ``url``, in ``folder``: files named in ``contents`` as they are, of others the names.

    Raises:
        LogError: there is no access.
    """
    from pyarrow.fs import FileSelector, FileType

    try:
        system, base = file_system(url)
        for found in system.get_file_info(FileSelector(base, allow_not_found=True, recursive=True)):
            if found.type != FileType.File:
                continue
            here = folder / found.path[len(base.rstrip("/")) + 1 :]
            here.parent.mkdir(parents=True, exist_ok=True)
            here.touch()
            if here.name in contents:
                with system.open_input_stream(found.path) as source, here.open("wb") as copy:
                    shutil.copyfileobj(source, copy, PIECE)
    except (OSError, ValueError) as error:
        raise LogError(f"{hidden(url)} cannot be read: {str(error).splitlines()[0]}") from None


def send_files(files: Sequence[Path], url: str, last: str | None = None) -> None:
    """Copies ``files`` into the folder ``url``; the one named ``last`` is removed first and copied last.

    Raises:
        LogError: there is no access, or no room.
    """
    try:
        system, base = file_system(url)
        system.create_dir(base, recursive=True)
        if last is not None and _is_file(system, f"{base}/{last}"):
            system.delete_file(f"{base}/{last}")
        for file in sorted(files, key=lambda f: (f.name == last, f.name)):
            with file.open("rb") as source, system.open_output_stream(f"{base}/{file.name}") as copy:
                shutil.copyfileobj(source, copy, PIECE)
    except (OSError, ValueError) as error:
        raise LogError(f"{hidden(url)} cannot be written: {str(error).splitlines()[0]}") from None


def inside(url: str, name: str) -> str:
    """The URL of something in the folder ``url``, whose options follow ``?``.

    >>> inside("s3://bench/out?region=x", "drive")
    's3://bench/out/drive?region=x'
    """
    address, mark, options = url.partition("?")
    return f"{address.rstrip('/')}/{name}{mark}{options}"


def _is_file(system: Any, path: str) -> bool:
    from pyarrow.fs import FileType

    return bool(system.get_file_info(path).type == FileType.File)
