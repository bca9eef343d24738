"""Pictures of a recording's tabs without a screen: the native viewer, drawn by a software Vulkan driver."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from ingest.errors import DynoscopeError, LogError
from viz.send import TIMELINE
from viz.viewer import connected, free_port, is_recording, start

DRIVERS = Path("/usr/share/vulkan/icd.d")
TIMEOUT_S = 120.0
TOASTS_S = 5.0
"""Messages of the start cover a corner for about this long."""


def software_driver() -> Path | None:
    """The description of Mesa's software Vulkan driver, None where it is not installed."""
    return next(iter(sorted(DRIVERS.glob("lvp_icd.*json"))), None)


def render(recording: Path, folder: Path, *, at: float | None = None) -> list[Path]:
    """One PNG per tab, ``folder/<tab>.png``, with the cursor at ``at`` s (None: where it opens).

    Raises:
        LogError: ``recording`` is not one.
        DynoscopeError: there is no software driver, the recording does not load, or a view reports a problem.
    """
    if not is_recording(recording):
        raise LogError(f"{recording} is not a Rerun recording")
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    with viewer() as client:
        opened(client, recording)
        if at is not None:
            client.set_time(TIMELINE, duration=at, play_state="paused")
        time.sleep(TOASTS_S)
        for name in tabs(client):
            path = folder / f"{re.sub(r'[^a-z0-9]+', '_', name.lower())}.png"
            path.write_bytes(settled(client))
            pictures.append(path)
            _check(client, recording, name)
    return pictures


@contextmanager
def viewer(port: int | None = None) -> Iterator[ViewerClient]:
    """A viewer without a screen, reachable from this machine only, on ``port`` if given, and how to tell it
    what to do.

    Raises:
        DynoscopeError: there is no software driver, or the viewer does not start.
    """
    driver = software_driver()
    if driver is None:
        raise DynoscopeError(
            f"pictures need a software Vulkan driver, and there is none in {DRIVERS}; "
            "install it, on Debian: apt-get install libvulkan1 mesa-vulkan-drivers"
        )
    port = port or free_port()
    options = ["--headless", "--hide-welcome-screen", "--port", str(port)]
    with start(options, VK_ICD_FILENAMES=str(driver), RUST_LOG="off") as process:
        try:
            connected(process, port, TIMEOUT_S)
            yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        finally:
            process.terminate()


def opened(client: ViewerClient, recording: Path) -> None:
    """Open a recording; returns once the viewer has it.

    Raises:
        DynoscopeError: it does not load in time.
    """
    check = "check it with `rerun rrd verify`"
    try:
        reader = RrdReader(recording)
        ids = tuple(f":{one.recording_id}" for one in reader.recordings())
        timed = any(reader.store(store=one).schema().index_columns() for one in reader.recordings())
    except (RuntimeError, ValueError) as error:
        raise DynoscopeError(f"{recording} does not load: {error}; {check}") from None
    client.open(str(recording.resolve()))
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        state = client.get_state()
        there = [one for one in state.recordings if one.store_id.endswith(ids)]
        # a recording stands in the list before its data do; one of static data alone has no timeline ever
        if not state.loading and there and (not timed or any(one.timelines for one in there)):
            return
        time.sleep(0.05)
    raise DynoscopeError(f"{recording} did not load within {TIMEOUT_S:g} s; {check}")


def tabs(client: ViewerClient) -> Iterator[str]:
    """Bring each tab of the outermost container to the front, each page of those that have pages, and give
    its name; ``all`` without tabs."""
    blueprint: dict[str, Any] = client.get_blueprint().blueprint
    root = blueprint["/viewport"]["ViewportBlueprint"]["root_container"]
    yield from _pages(client, blueprint, f"container/{root}") or ["all"]


def _pages(client: ViewerClient, blueprint: dict[str, Any], path: str) -> Iterator[str] | None:
    """The tabs of a container in turn; None where it has no tabs."""
    entry: dict[str, Any] = blueprint[f"/{path.lstrip('/')}"].get("ContainerBlueprint", {})
    if entry.get("container_kind") != "Tabs":
        return None

    def each() -> Iterator[str]:
        for tab in np.atleast_1d(entry["contents"]).tolist():  # a single one stands without a list
            entry["active_tab"] = tab
            told = blueprint[f"/{tab.lstrip('/')}"].values()
            name = str(next(e["display_name"] for e in told if "display_name" in e))
            if pages := _pages(client, blueprint, tab):
                yield from (f"{name} {page}" for page in pages)
            else:
                client.set_blueprint(blueprint, of="recording")
                yield name

    return each()


def settled(client: ViewerClient) -> bytes:
    """The picture once two in a row are equal: data arrives while frames are drawn."""
    deadline = time.monotonic() + TIMEOUT_S
    last = b""
    while (picture := client.take_screenshot()) != last and time.monotonic() < deadline:
        last = picture
    return picture


def _check(client: ViewerClient, recording: Path, tab: str) -> None:
    reports = [f"{view.name}: {report}" for view in client.get_state().views for report in view.reports]
    logs = [e.message for e in client.get_logs() if e.level in ("WARN", "ERROR")]
    problems = reports + [m for m in logs if "oftware rasterizer" not in m]
    if problems:
        raise DynoscopeError(f"{recording}, tab {tab}: the viewer reports {'; '.join(problems)}")
