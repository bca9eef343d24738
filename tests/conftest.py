"""For all tests. Property-based ones have no deadline: how fast a machine is says nothing about the code."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("dynoscope", deadline=None)
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
