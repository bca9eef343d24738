"""Running a detector over many logs: one bad log never stops the rest, and what is done is not done again."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import polars as pl

from ingest.errors import DynoscopeError, LogError
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.digest import file_sha256
from pipeline.files import aside
from pipeline.manifest import build_manifest, run_key
from pipeline.outputs import ANNOTATED, MANIFEST, SAMPLES, TIMELINE, VERDICT, write_run

SUMMARY_SCHEMA = {
    "log": pl.String, "status": pl.String, "reason": pl.String, "recipe": pl.String, "detector": pl.String,
    "fault": pl.String, "signal": pl.String, "set": pl.String, "p": pl.Float64, "onset_s": pl.Float64,
    "detected_s": pl.Float64, "magnitude": pl.Float64, "magnitude_sd": pl.Float64, "unit": pl.String,
    "usable_s": pl.Float64, "truth": pl.String,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a batch is run; none of these changes what a verdict says."""

    timeline: bool = True
    force: bool = False
    name_map: Path | None = None
    debug: bool = False  # show the traceback of a log that failed


def run(
    logs: Sequence[Path],
    detector: Detector,
    out: Path,
    options: Options | None = None,
    progress: Callable[[str, dict[str, Any]], None] = lambda log, row: None,
) -> pl.DataFrame:
    """Diagnose ``logs`` into ``out/<log>/`` and return the summary, one row per log, failed ones too.

    ``summary.parquet`` and ``summary.csv`` in ``out`` are right after every log.

    Raises:
        LogError: ``out`` cannot be written.
    """
    from ingest.files import unique_stems

    options = options or Options()
    rows: dict[str, dict[str, Any]] = {}
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"output folder {out} cannot be made: {error.strerror or error}") from None
    for name, path in zip(unique_stems(logs), logs, strict=True):
        try:
            rows[name] = _run_one(path, name, detector, out / name, options)
        except Exception as error:  # whatever it is, the other logs are not to suffer
            rows[name] = _failure(path, name, error)
            if options.debug:
                traceback.print_exception(error)
        rows[name] |= {"recipe": detector.recipe.name, "detector": detector.key}
        write_summary(list(rows.values()), out)
        progress(name, rows[name])
    return summary_frame(list(rows.values()))


def _run_one(path: Path, name: str, detector: Detector, folder: Path, options: Options) -> dict[str, Any]:
    from ingest import read_log
    from ingest.report import quality, with_quality

    began = time.perf_counter()
    if not path.is_file():
        raise LogError(f"{path}: {'a folder without logs' if path.is_dir() else 'there is no such file'}")
    sha256 = file_sha256(path)
    map_sha256 = file_sha256(options.name_map) if options.name_map else None
    key = run_key(sha256, detector, {"map": map_sha256})
    if not options.force and (row := _done(name, folder, key, options)):
        return row
    log = read_log(path, options.name_map)
    log = replace(log, name=name, facts={**log.facts, "sha256": sha256, "path": str(path)})
    log = with_quality(log)
    diagnosis = diagnose(log, detector, quality=quality(log))
    times: dict[str, float | str] = {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(time.perf_counter() - began, 3),
    }
    manifest = build_manifest(log, detector, key, times)
    write_run(diagnosis, folder, manifest, timeline=options.timeline)
    return verdict_row(name, diagnosis.verdict.to_json(), manifest)


def _failure(path: Path, name: str, error: Exception) -> dict[str, Any]:
    """The row of a log that failed; it says nothing of where the log lay."""
    reason = str(error) if isinstance(error, DynoscopeError) else f"{type(error).__name__}: {error}"
    return {"log": name, "status": "failed", "reason": reason.replace(str(path), path.name)}


def _done(name: str, folder: Path, key: str, options: Options) -> dict[str, Any] | None:
    """The row of a log that has been run with the same ``key``, all its files in place; else None."""
    files = (SAMPLES, ANNOTATED, *([TIMELINE] if options.timeline else []))
    try:
        manifest, verdict = (
            json.loads((folder / file).read_text(encoding="utf-8")) for file in (MANIFEST, VERDICT)
        )
        done = manifest["key"] == key and all((folder / file).is_file() for file in files)
        return verdict_row(name, verdict, manifest) if done else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError):  # damaged: run it again
        return None


def verdict_row(name: str, verdict: dict[str, Any], manifest: dict[str, Any]) -> dict[str, Any]:
    """A row of the summary from a run's verdict and manifest."""
    magnitude, salvaged = verdict["magnitude"] or {}, manifest["log"].get("salvaged", [])
    return {
        "log": name,
        "status": "salvaged" if salvaged else "ok",
        "reason": "; ".join(salvaged) or None,
        "fault": verdict["fault"],
        "signal": verdict["signal"],
        "set": " ".join(verdict["set"]),
        "p": verdict["probability"].get(verdict["fault"]),
        "onset_s": verdict["onset_s"],
        "detected_s": verdict["detected_s"],
        "magnitude": magnitude.get("value"),
        "magnitude_sd": magnitude.get("sd"),
        "unit": magnitude.get("unit"),
        "usable_s": verdict["statistics"].get("usable_s"),
        "truth": " ".join(verdict["statistics"].get("truth", [])) or None,
    }


def summary_frame(rows: Sequence[dict[str, Any]]) -> pl.DataFrame:
    """The summary's table; what a row does not say is null."""
    return pl.DataFrame([{c: row.get(c) for c in SUMMARY_SCHEMA} for row in rows], schema=SUMMARY_SCHEMA)


def write_summary(rows: Sequence[dict[str, Any]], out: Path) -> None:
    """``summary.parquet`` and ``summary.csv`` of ``rows``, each replaced whole."""
    frame = summary_frame(rows)
    try:
        with aside(out / "summary.parquet") as draft:
            frame.write_parquet(draft)
        with aside(out / "summary.csv") as draft:
            frame.write_csv(draft)
    except OSError as error:
        raise LogError(f"the summary in {out} cannot be written: {error.strerror or error}") from None
