"""The manifest of a run: what was read, the steps with versions and settings, packages, times."""

from __future__ import annotations

import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ingest.log import Log
from pipeline.digest import digest, settings

if TYPE_CHECKING:
    from pipeline.detector import Detector

PACKAGES = ("dynoscope", "mcap", "numba", "numpy", "polars", "pyarrow", "rerun-sdk", "scipy")

FACTS = ("file", "sha256", "format", "path", "salvaged", "vehicle", "start_time")


def run_key(sha256: str, detector: Detector, options: dict[str, Any]) -> str:
    """Content key of a run: same log, detector, options and program version, same outputs."""
    return digest(sha256, detector.key, options, version("dynoscope"))


def build_manifest(
    log: Log,
    detector: Detector,
    key: str,
    times: dict[str, float | str],
    duration_s: float | None = None,
) -> dict[str, Any]:
    """Lineage of one run: each step's output key is the digest of its settings and its input's key.

    ``duration_s`` of a log whose rows are not in ``log``.
    """
    steps, parent = [], str(log.facts.get("sha256", log.name))
    for use, stage in zip(detector.recipe.uses, detector.stages, strict=True):
        output = digest(use, stage.version, settings(stage), detector.key, parent)
        steps.append(
            {
                "stage": use,
                "version": stage.version,
                "settings": settings(stage),
                "input": parent,
                "output": output,
            }
        )
        parent = output
    return {
        "key": key,
        "log": {k: log.facts[k] for k in FACTS if k in log.facts}
        | {"duration_s": round(duration(log) if duration_s is None else duration_s, 6)},
        "detector": {k: detector.record[k] for k in ("key", "recipe", "training", "calibration", "notes")},
        "steps": steps,
        "packages": packages(),
        "python": platform.python_version(),
        "source": source_state(),
        "times": times,
    }


def duration(log: Log) -> float:
    """Seconds from the first sample to the last."""
    start, end = log.span
    return end - start


@cache
def packages() -> dict[str, str]:
    """Versions of the packages that numbers depend on."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


@cache
def source_state() -> dict[str, Any] | None:
    """Commit of the program's own checkout and whether it was changed; None outside one."""
    folder = Path(__file__).resolve().parents[1]
    if not (folder / ".git").exists():
        return None
    try:
        head, status = (
            subprocess.run(
                ["git", *words], cwd=folder, capture_output=True, text=True, timeout=10, check=True
            ).stdout
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain"])
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": head.strip(), "changed": bool(status.strip())}
