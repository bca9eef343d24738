"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from platform import node


def write_aside(path: Path, content: bytes) -> None:
    """Write ``content`` beside ``path``, then rename: a reader sees the old file or the new one."""
    with aside(path) as draft:
        draft.write_bytes(content)


@contextmanager
def aside(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to, renamed to it on success and removed on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.stem}.{owner()}{path.suffix}")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """A folder beside ``path`` to fill and rename; what is still there in the end is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{path.name}.{owner()}.", dir=path.parent))
    draft.chmod(0o755)
    try:
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def owner() -> str:
    """This machine and process, as drafts bear them in their names."""
    return f"{node()}-{os.getpid()}"


def sweep(folder: Path) -> None:
    """Take away the drafts in ``folder`` of processes of this machine that are no more."""
    ours = re.compile(rf"\..+\.{re.escape(node())}-(\d+)\.[^.]+(\.old)?")
    for draft in folder.iterdir():
        if (found := ours.fullmatch(draft.name)) and not _alive(int(found[1])):
            if draft.is_dir():
                shutil.rmtree(draft, ignore_errors=True)
            else:
                draft.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
