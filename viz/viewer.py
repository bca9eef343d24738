"""Opening recordings in the Rerun viewer, natively or in a browser, or saving them as one."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ingest.errors import DynoscopeError, LogError
from ingest.log import Log
from stages.results import Diagnosis

if TYPE_CHECKING:
    from rerun import RecordingStream

TIMELINE_FILE = "timeline.rrd"
MAGIC = b"RRF"
_NO_VIEWER = "open it in a browser with --web, or write it to a file with --save FILE.rrd"


def show(*sources: Path | Log | Diagnosis, web: bool = False, save: Path | None = None) -> None:
    """Open recordings, runs (a run's folder or a folder of runs), diagnoses and logs; returns when the viewer
    is closed.

    ``web`` serves them to a browser on this machine only; ``save`` writes one recording and opens nothing.

    Raises:
        LogError: a source holds nothing to show, or ``save`` cannot be written.
        DynoscopeError: there is no display, or the viewer failed.
    """
    from viz.timeline import write_log_timeline, write_timeline

    with tempfile.TemporaryDirectory(prefix="dynoscope-") as folder:
        recordings: list[Path] = []
        for number, source in enumerate(sources):
            if isinstance(source, Log):
                recordings.append(Path(folder) / f"{number}.rrd")
                write_log_timeline(source, recordings[-1])
            elif isinstance(source, Diagnosis):
                recordings.append(Path(folder) / f"{number}.rrd")
                write_timeline(source, recordings[-1])
            else:
                recordings += timelines_in(source)
        if save is not None:
            merge(recordings, save)
        elif web:
            page, data = free_port(9090), free_port(9876)
            _tell_page(page, data)
            _watch(["--serve-web", "--web-viewer-port", str(page), "--port", str(data)], recordings)
        else:
            _check_display()
            _watch(["--port", "auto"], recordings)


def is_recording(path: Path) -> bool:
    """Whether ``path`` is a file that begins as Rerun's recordings do."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def holds_recordings(path: Path) -> bool:
    """Whether ``path`` is a run's folder or a folder of runs that left timelines."""
    return path.is_dir() and any(_timelines(path))


def _timelines(folder: Path) -> Iterator[Path]:
    own = folder / TIMELINE_FILE
    yield from [own] if own.is_file() else sorted(folder.glob(f"*/{TIMELINE_FILE}"))


def timelines_in(path: Path) -> list[Path]:
    """The recordings of ``path``: itself, a run's ``timeline.rrd``, or those of all runs in it.

    Raises:
        LogError: there is none.
    """
    if is_recording(path):
        return [path]
    if found := list(_timelines(path)):
        return found
    expected = "expected a Rerun recording, a run's folder or a folder of runs"
    if not path.is_dir():
        raise LogError(f"{path} {'is something else' if path.exists() else 'does not exist'}; {expected}")
    raise LogError(
        f"{path} holds no {TIMELINE_FILE}; {expected}. Run without --no-timeline to have it written"
    )


def merge(recordings: Sequence[Path], path: Path) -> None:
    """Several recordings as one file, which appears whole or not at all.

    Raises:
        LogError: the folder does not exist, or a recording is damaged.
    """
    check_folder(path)
    for recording in recordings:
        _rerun("verify", str(recording), failed=f"{recording} is damaged; run its log again")
    aside = path.with_name(f".{path.name}.{os.getpid()}.rrd")
    try:
        if len(recordings) == 1:
            shutil.copyfile(recordings[0], aside)
        else:
            _rerun("merge", "-o", str(aside), *map(str, recordings), failed=f"cannot merge into {path}")
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def check_folder(path: Path) -> None:
    """Raises:
    LogError: the folder that ``path`` is to be in does not exist."""
    if not path.parent.is_dir():
        raise LogError(f"cannot write {path}: there is no folder {path.parent}; make it first")


def _rerun(*words: str, failed: str) -> None:
    done = subprocess.run([str(executable()), "rrd", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise LogError(f"{failed} ({' '.join(done.stderr.split()[-20:])})")


def executable() -> Path:
    """The viewer that came with the SDK (not its launcher, which would leave it running when stopped)."""
    import rerun_cli  # type: ignore[import-untyped]

    return Path(rerun_cli.__file__).parent / ("rerun.exe" if os.name == "nt" else "rerun")


@contextmanager
def live_recording(name: str, *, web: bool = False) -> Iterator[tuple[RecordingStream, Callable[[], None]]]:
    """A viewer, native or in a browser on this machine, and a recording that it shows as it is made; and what
    returns when the viewer is closed.

    Raises:
        DynoscopeError: there is no display, or the viewer does not start.
    """
    import rerun as rr

    from viz.timeline import application_id

    data = free_port(9876)
    options = ["--hide-welcome-screen"]
    if web:
        page = free_port(9090)
        options = ["--serve-web", "--web-viewer-port", str(page)]
        _tell_page(page, data)
    else:
        _check_display()
    with start([*options, "--port", str(data)]) as viewer:
        try:
            connected(viewer, data)
            rec = rr.RecordingStream(application_id(name), send_properties=False)
            rec.set_log_time_enabled(False)
            rec.connect_grpc(f"rerun+http://127.0.0.1:{data}/proxy")
            rec.send_recording_name(name)
            yield rec, lambda: _until_closed(viewer)
            rec.disconnect()
        finally:
            viewer.terminate()


def connected(viewer: subprocess.Popen[bytes], port: int, within_s: float = 60.0) -> None:
    """Returns once the viewer listens on ``port``.

    Raises:
        DynoscopeError: it has ended, or does not listen in time.
    """
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline and viewer.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise DynoscopeError(f"the viewer did not start (status {viewer.poll()}); {_NO_VIEWER}")


def _tell_page(page: int, data: int) -> None:
    url = f"http://127.0.0.1:{page}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data}%2Fproxy"
    print(f"open {url} in a browser; stop with Ctrl-C", file=sys.stderr, flush=True)


def _check_display() -> None:
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in displays):
        raise DynoscopeError(f"there is no display to open a viewer on; {_NO_VIEWER}")


def free_port(wanted: int = 0) -> int:
    """``wanted`` if it is free on this machine, else one that is."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return free_port()
        return int(probe.getsockname()[1])


def start(options: Sequence[str], **environment: str) -> subprocess.Popen[bytes]:
    """Start the viewer; it is reachable from this machine only."""
    command = [str(executable()), "--bind", "127.0.0.1", *options]
    return subprocess.Popen(command, env={"RUST_LOG": "warn", **os.environ, **environment})


def _watch(options: Sequence[str], recordings: Sequence[Path]) -> None:
    """Run the viewer until it is closed or interrupted."""
    with start([*options, *map(str, recordings)]) as viewer:
        _until_closed(viewer)


def _until_closed(viewer: subprocess.Popen[bytes]) -> None:
    try:
        while viewer.poll() is None:  # not wait(): polars has interrupted system calls restarted
            time.sleep(0.1)
    except KeyboardInterrupt:
        viewer.terminate()
        return
    if viewer.returncode:
        raise DynoscopeError(f"the Rerun viewer ended with status {viewer.returncode}; {_NO_VIEWER}")
