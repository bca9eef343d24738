"""Where a file comes from: walked back from its manifest or record, and checked where it can be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from ingest.errors import LogError, RecipeError, StoreError, did_you_mean
from ingest.files import sha256, url_of
from pipeline.detector import load_record
from pipeline.outputs import ANNOTATED, MANIFEST, SAMPLES, SIGNALS, TIMELINE, VERDICT
from pipeline.recipe import stage_of

MADE_BY = {SAMPLES: "its columns by the step that is said to add them", VERDICT: "from the samples",
           ANNOTATED: "the log with the samples as channels", TIMELINE: "from the log, samples and verdict",
           SIGNALS: "the monitored signals", MANIFEST: "this lineage itself"}  # fmt: skip


def explain(path: Path) -> dict[str, Any]:
    """What is known of a file of a run, a run's folder, a summary, or a detector, as JSON values.

    Raises:
        LogError: no such file, or nothing is known of it.
        StoreError: a detector's record is damaged.
    """
    if not path.exists():
        raise LogError(f"{path}: there is no such file")
    if path.is_dir() and (path / MANIFEST).is_file():
        return {"folder": str(path), **_of_run(path)}
    if path.is_dir() and (path / "summary.parquet").is_file():
        path = path / "summary.parquet"
    if path.name in ("summary.parquet", "summary.csv", "fleet.csv"):
        return _of_summary(path)
    if (path.parent / MANIFEST).is_file():
        return _of_file(path)
    if path.suffix in (".npz", ".json") and path.with_suffix(".json").is_file():
        return _of_detector(path)
    raise LogError(
        f"{path}: nothing is known of it: expected a run's folder or a file in it ({', '.join(MADE_BY)}), "
        "a summary, or a detector of a store"
    )


def _of_file(path: Path) -> dict[str, Any]:
    if path.name not in MADE_BY:
        raise LogError(f"{path} was not written by a run; {did_you_mean(path.name, MADE_BY)}")
    return {"file": str(path), "sha256": sha256(path), "what": MADE_BY[path.name], **_of_run(path.parent)}


def _of_run(folder: Path) -> dict[str, Any]:
    manifest = _manifest(folder / MANIFEST)
    log = manifest["log"]
    steps = [{**step, **_columns(step)} for step in reversed(manifest["steps"])]
    return {
        "made": manifest["times"], "key": manifest["key"], "packages": manifest["packages"],
        "python": manifest["python"], "source": manifest["source"], "steps": steps,
        "detector": manifest["detector"], "log": {**log, "now": _state(log)},
    }  # fmt: skip


def _manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = dict(json.loads(path.read_text(encoding="utf-8")))
        for key in ("times", "key", "packages", "python", "source", "steps", "detector", "log"):
            manifest[key]
        return manifest
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LogError(f"{path} cannot be read: {error!r}; run the log again") from None


def _columns(step: Mapping[str, Any]) -> dict[str, Any]:
    """The columns that a step adds, where its settings alone say so."""
    try:
        return {"adds": sorted(stage_of(step["stage"], step["settings"]).adds)}
    except RecipeError:  # a stage of another version, or one that is not here
        return {}


def _state(log: Mapping[str, Any]) -> str:
    """Whether the log still is what was read."""
    path = Path(str(log.get("path", "")))
    if url_of(path):
        return "not looked at, it is behind a URL"
    if not path.is_file():
        return "not there any more"
    return "unchanged" if sha256(path) == log["sha256"] else "changed since"


def _of_summary(path: Path) -> dict[str, Any]:
    frame = pl.read_csv(path) if path.suffix == ".csv" else pl.read_parquet(path)
    folders = [path.parent / str(log) for log in frame["log"]] if "log" in frame.columns else []
    runs = [
        {"log": f.name, "manifest": str(f / MANIFEST), "key": _manifest(f / MANIFEST)["key"]}
        for f in folders
        if (f / MANIFEST).is_file()
    ]
    return {
        "file": str(path), "sha256": sha256(path), "rows": frame.height,
        "what": "one row per run, from its verdict and manifest" if runs else "counted from summary.parquet",
        "runs": runs,
    }  # fmt: skip


def _of_detector(path: Path) -> dict[str, Any]:
    record = load_record(path.with_suffix(".json"))
    if not path.with_suffix(".npz").is_file():
        raise StoreError(f"detector {path.stem} has no arrays ({path.stem}.npz); fit it again")
    known = ("key", "recipe", "created", "training", "calibration", "versions", "notes")
    origin = ("challenges", "how", "calibrated_from", "false_alarms", "left_out")  # where they apply
    told = {k: record[k] for k in (*known, *(k for k in origin if k in record))}
    return {"file": str(path), "what": "a detector", **told}
