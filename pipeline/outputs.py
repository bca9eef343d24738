"""What a run leaves behind for one log: samples, verdict, annotated log, timeline, manifest."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from ingest.log import TIME, Group, Log, Signal
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA
from stages.results import Diagnosis

SAMPLES, VERDICT, ANNOTATED, TIMELINE, MANIFEST = (
    "samples.parquet", "verdict.json", "annotated.mcap", "timeline.rrd", "manifest.json",
)  # fmt: skip


def write_run(diagnosis: Diagnosis, folder: Path, manifest: dict[str, Any], *, timeline: bool = True) -> None:
    """Write everything about one log to ``folder``, which appears whole or not at all."""
    from ingest import write_log

    folder.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        diagnosis.samples.write_parquet(draft / SAMPLES)
        (draft / VERDICT).write_text(to_json(diagnosis.verdict.to_json()), encoding="utf-8")
        write_log(annotated(diagnosis), draft / ANNOTATED)
        if timeline:
            from viz.timeline import write_timeline

            write_timeline(diagnosis, draft / TIMELINE)
        (draft / MANIFEST).write_text(to_json(manifest), encoding="utf-8")
        draft.chmod(0o755)
        if folder.exists():
            folder.rename(old := draft.with_name(draft.name + ".old"))
            draft.rename(folder)
            shutil.rmtree(old)
        else:
            draft.rename(folder)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def annotated(diagnosis: Diagnosis) -> Log:
    """The log with the samples as further groups (``residuals``, ``regime``, ``verdict``) and the findings as
    events."""
    samples = diagnosis.samples
    kinds = {
        "residuals": [c for c in samples.columns if c.startswith((RESIDUAL, SIGMA, MODEL_SD, "z."))],
        "verdict": [c for c in samples.columns if c.startswith(("detection", "evidence.", "p."))],
    }
    kinds["regime"] = [c for c in samples.columns if c not in (TIME, *kinds["residuals"], *kinds["verdict"])]
    log = diagnosis.log
    groups = {
        name: _group(name, samples.select(TIME, *columns), diagnosis)
        for name, columns in kinds.items()
        if columns
    }
    return replace(log, groups={**log.groups, **groups}).with_events(diagnosis.verdict.events)


def to_json(value: Any) -> str:
    """JSON text with one key a line; NaN is not JSON and raises."""
    return json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _group(name: str, frame: pl.DataFrame, diagnosis: Diagnosis) -> Group:
    signals = {}
    for c in frame.columns[1:]:
        kind, _, residual = c.partition(".")
        unit = diagnosis.units.get(residual) if kind in ("residual", "sigma", "model_sd") else "1"
        state = frame.schema[c].is_integer() or frame.schema[c] == pl.Boolean
        signals[c] = Signal(
            name=c, unit=unit, kind="state" if state else "continuous", resample="hold" if state else "linear"
        )
    return Group(name, frame, signals)
