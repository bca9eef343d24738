"""Opening recordings in the Rerun viewer, natively or in a browser, or saving them as one."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ingest.errors import DynoscopeError, LogError
from ingest.log import Log

TIMELINE_FILE = "timeline.rrd"
MAGIC = b"RRF"
_NO_VIEWER = "open it in a browser with --web, or write it to a file with --save FILE.rrd"


def show(*sources: Path | Log, web: bool = False, save: Path | None = None) -> None:
    """Open recordings, runs (a run's folder or a folder of runs) and logs; returns when the viewer is closed.

    ``web`` serves them to a browser on this machine only; ``save`` writes one recording and opens nothing.

    Raises:
        LogError: a source holds nothing to show, or ``save`` cannot be written.
        DynoscopeError: there is no display, or the viewer failed.
    """
    from viz.timeline import write_log_timeline

    with tempfile.TemporaryDirectory(prefix="dynoscope-") as folder:
        recordings: list[Path] = []
        for number, source in enumerate(sources):
            if isinstance(source, Log):
                recordings.append(Path(folder) / f"{number}.rrd")
                write_log_timeline(source, recordings[-1])
            else:
                recordings += timelines_in(source)
        if save is not None:
            merge(recordings, save)
        elif web:
            _watch(["--serve-web", "--bind", "127.0.0.1"], recordings)
        else:
            _check_display()
            _watch(["--port", "auto"], recordings)


def timelines_in(path: Path) -> list[Path]:
    """The recordings of ``path``: itself, a run's ``timeline.rrd``, or those of all runs in it.

    Raises:
        LogError: there is none.
    """
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                return [path]
        raise LogError(f"{path} is not a Rerun recording; expected an .rrd file, a run's folder or a log")
    if not path.is_dir():
        raise LogError(f"{path} does not exist; expected an .rrd file, a run's folder or a log")
    found = (
        [path / TIMELINE_FILE]
        if (path / TIMELINE_FILE).is_file()
        else sorted(path.glob(f"*/{TIMELINE_FILE}"))
    )
    if not found:
        raise LogError(
            f"folder {path} has nothing to show: no {TIMELINE_FILE} in it nor in its folders. "
            "Run without --no-timeline to have them written"
        )
    return found


def merge(recordings: Sequence[Path], path: Path) -> None:
    """Several recordings as one file, which appears whole or not at all.

    Raises:
        LogError: the folder does not exist, or a recording is damaged.
    """
    if not path.parent.is_dir():
        raise LogError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    aside = path.with_name(f".{path.name}.{os.getpid()}.rrd")
    try:
        if len(recordings) == 1:
            shutil.copyfile(recordings[0], aside)
        else:
            command = [str(executable()), "rrd", "merge", "-o", str(aside), *map(str, recordings)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise LogError(f"cannot merge into {path}: {done.stderr.strip().splitlines()[-1]}")
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def executable() -> Path:
    """The viewer that came with the SDK (not its launcher, which would leave it running when stopped)."""
    import rerun_cli  # type: ignore[import-untyped]

    return Path(rerun_cli.__file__).parent / ("rerun.exe" if os.name == "nt" else "rerun")


def _check_display() -> None:
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in displays):
        raise DynoscopeError(f"there is no display to open a viewer on; {_NO_VIEWER}")


def _watch(options: list[str], recordings: Sequence[Path]) -> None:
    """Run the viewer until it is closed or interrupted."""
    try:
        status = subprocess.run([str(executable()), *options, *map(str, recordings)], check=False).returncode
    except KeyboardInterrupt:
        return
    if status:
        raise DynoscopeError(f"the Rerun viewer ended with status {status}; {_NO_VIEWER}")
