from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import psutil  # type: ignore[import-untyped]
import pytest
from PIL import Image
from rerun.chunk import RrdReader

import viz
from ingest.errors import DynoscopeError, LogError
from ingest.log import Group, Log
from viz.timeline import write_log_timeline
from viz.viewer import connected, free_port, holds_recordings, is_recording, start, timelines_in


def small(name: str) -> Log:
    return Log(name=name, groups={"g": Group("g", pl.DataFrame({"time": [0.0, 1.0], "v": [1.0, 2.0]}))})


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder of two runs with timelines and one without."""
    for name in ("b", "a"):
        (tmp_path / "out" / name).mkdir(parents=True)
        write_log_timeline(small(name), tmp_path / "out" / name / "timeline.rrd")
    (tmp_path / "out" / "c").mkdir()
    return tmp_path / "out"


def names(path: Path) -> set[str]:
    return {r.application_id for r in RrdReader(path).recordings()}


def test_show_is_a_function_before_and_after_its_module_is_imported() -> None:
    code = "import viz, viz.viewer; assert callable(viz.show); from viz import show; assert callable(show)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_viz_does_not_import_rerun() -> None:
    code = (
        "import sys, viz, pipeline.commands.view; assert not {'rerun', 'polars', 'numpy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_recordings_are_found_where_runs_leave_them(out: Path) -> None:
    one = out / "a" / "timeline.rrd"
    assert timelines_in(one) == timelines_in(out / "a") == [one]
    assert timelines_in(out) == [one, out / "b" / "timeline.rrd"]
    assert holds_recordings(out)
    assert holds_recordings(out / "a")
    assert not holds_recordings(out / "c")
    assert is_recording(one)
    assert not is_recording(out)


def test_what_is_no_recording_is_named(out: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.rrd").write_text("RR, not a recording")
    for path, message in (
        (out / "c", "holds no timeline.rrd.*--no-timeline"),
        (tmp_path / "nowhere", "does not exist"),
        (tmp_path / "notes.rrd", "is something else"),
    ):
        with pytest.raises(LogError, match=message):
            viz.show(path, save=tmp_path / "x.rrd")
    assert not (tmp_path / "x.rrd").exists()


def test_runs_and_logs_are_saved_as_one_recording(out: Path, tmp_path: Path) -> None:
    save = tmp_path / "all.rrd"
    viz.show(out, small("plain"), save=save)
    assert names(save) == {"dynoscope a", "dynoscope b", "dynoscope plain"}
    viz.show(small("alone"), save=save)
    assert names(save) == {"dynoscope alone"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["all.rrd", "out"]


def test_saving_says_what_is_wrong(out: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="there is no folder"):
        viz.show(out, save=tmp_path / "no" / "all.rrd")
    damaged = out / "b" / "timeline.rrd"
    damaged.write_bytes(damaged.read_bytes()[:900])
    with pytest.raises(LogError, match="damaged; run its log again"):
        viz.show(out, save=tmp_path / "all.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems always have a display")
def test_without_a_display_the_ways_out_are_named(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(DynoscopeError, match=r"no display.*--web.*--save"):
        viz.show(out)


def test_a_free_port_is_kept_and_a_taken_one_avoided() -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) not in (0, port)
    assert free_port(port) == port


def test_the_browser_is_served_on_this_machine_only_until_interrupted(out: Path) -> None:
    code = f"""
import signal, viz
from pathlib import Path
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background is born without it
viz.show(Path({str(out)!r}), web=True)
"""
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        url = line.split()[1]
        try:
            page = _fetch(url)
            viewers = psutil.Process(process.pid).children(recursive=True)
            listening = [c.laddr.ip for p in viewers for c in p.net_connections() if c.status == "LISTEN"]
        finally:
            process.send_signal(signal.SIGINT)
            try:
                status = process.wait(timeout=10)
            finally:
                process.kill()
    assert b"<html" in page.lower()
    assert len(listening) >= 2
    assert set(listening) == {"127.0.0.1"}
    assert status == 0
    assert not any(p.is_running() for p in viewers)


def test_a_browser_draws_it(log: Log, tmp_path: Path, watch: Callable[[str], bytes]) -> None:
    """The web viewer, served as ``--web`` does it, in a browser: the curves' colour covers a good part."""
    write_log_timeline(log, tmp_path / "drive.rrd")
    page, data = free_port(9090), free_port(9876)
    options = ["--serve-web", "--web-viewer-port", str(page), "--port", str(data)]
    url = (
        f"http://127.0.0.1:{page}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data}%2Fproxy&hide_welcome_screen=1"
    )
    with start([*options, str(tmp_path / "drive.rrd")]) as viewer:
        try:
            connected(viewer, page)
            deadline, blue = time.monotonic() + 90.0, 0
            while blue < 3000 and time.monotonic() < deadline:
                time.sleep(1.0)
                pixels = np.asarray(Image.open(io.BytesIO(watch(url))).convert("RGB"), dtype=int)
                blue = int((np.abs(pixels - (86, 180, 233)).max(axis=2) <= 40).sum())
        finally:
            viewer.terminate()
    assert blue >= 3000


def _fetch(url: str) -> bytes:
    deadline = time.monotonic() + 20.0
    while True:
        try:
            with urllib.request.urlopen(url, timeout=2.0) as answer:
                return bytes(answer.read())
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def test_the_environment_is_left_alone(out: Path, tmp_path: Path) -> None:
    before = dict(os.environ)
    viz.show(out, save=tmp_path / "all.rrd")
    assert dict(os.environ) == before
