"""For all tests. Property-based ones try the same examples in every run, others by
``--hypothesis-profile=explore``, and have no deadline: how fast a machine is says nothing about the code."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

settings.register_profile("dynoscope", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None, max_examples=300)
settings.load_profile("dynoscope")

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
Browse = Callable[..., str]


@pytest.fixture(scope="session")
def browse(tmp_path_factory: pytest.TempPathFactory) -> Browse:
    """``browse(url, *options, light=False)``: what a headless Chromium, without a network, prints."""
    executable = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if executable is None:
        pytest.skip("no Chromium here to open pages with: apt-get install chromium")
    profile: Path = tmp_path_factory.mktemp("browser")

    def opened(url: str, *options: str, light: bool = False) -> str:
        command = [
            executable, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
            f"--user-data-dir={profile}", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
            f"--blink-settings=preferredColorScheme={int(light)}", *options, url,
        ]  # fmt: skip
        return subprocess.run(command, capture_output=True, text=True, timeout=90, check=True).stdout

    return opened


@pytest.fixture(scope="session")
def watch(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], bytes]]:
    """``watch(url)``: a PNG of a page as a headless Chromium with software WebGL shows it now; it stays open
    from call to call. Spoken to through pipes, as its protocol for tools has it."""
    executable = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if executable is None:
        pytest.skip("no Chromium here to open pages with: apt-get install chromium")
    (ours, theirs), (answers, told) = os.pipe(), os.pipe()  # it reads from 3 and writes to 4
    command = [
        executable, "--headless", "--no-sandbox", "--hide-scrollbars", "--use-gl=angle",
        "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--window-size=1400,900", "--blink-settings=preferredColorScheme=0", "--remote-debugging-pipe",
        f"--user-data-dir={tmp_path_factory.mktemp('watcher')}",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    ]  # fmt: skip
    process = subprocess.Popen(
        command, stderr=subprocess.DEVNULL, close_fds=False,
        preexec_fn=lambda: [os.dup2(ours, 3), os.dup2(told, 4)],
    )  # fmt: skip
    os.close(ours)
    os.close(told)
    numbers, sessions = count(1), dict[str, str]()
    with open(theirs, "wb", buffering=0) as out, open(answers, "rb") as back:
        rest = bytearray()

        def ask(method: str, session: str | None = None, **params: object) -> dict[str, Any]:
            number = next(numbers)
            asked = {"id": number, "method": method, "params": params}
            out.write(json.dumps(asked | ({"sessionId": session} if session else {})).encode() + b"\0")
            while True:
                while b"\0" not in rest:
                    rest.extend(back.read1(1 << 16) or b"\0")
                message, _, after = bytes(rest).partition(b"\0")
                rest[:] = after
                if (answer := json.loads(message or b"{}")).get("id") == number:
                    return dict(answer["result"])

        def picture(url: str) -> bytes:
            if url not in sessions:
                target = ask("Target.createTarget", url=url)["targetId"]
                sessions[url] = ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            return base64.b64decode(ask("Page.captureScreenshot", sessions[url], format="png")["data"])

        yield picture
        process.terminate()
        process.wait(timeout=20)
