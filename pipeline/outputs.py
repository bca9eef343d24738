"""What a run leaves behind for one log: samples, verdict, annotated log, timeline, manifest."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from ingest.errors import LogError
from ingest.log import TIME, Group, Log, Signal
from pipeline.files import draft_folder
from stages.compensate import CORRECTED, CORRECTED_SD
from stages.monitor import INDICATOR
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA
from stages.results import Diagnosis

SAMPLES, SIGNALS, VERDICT, ANNOTATED, TIMELINE, MANIFEST = (
    "samples.parquet", "signals.parquet", "verdict.json", "annotated.mcap", "timeline.rrd", "manifest.json",
)  # fmt: skip
MEASURED = (RESIDUAL, INDICATOR)
SHOWN = "shown"  # of a manifest
ADDED = ("residuals", "regime", "verdict", "corrected")  # groups of the annotated log


def write_run(diagnosis: Diagnosis, folder: Path, manifest: dict[str, Any], *, timeline: bool = True) -> None:
    """Write everything about one log to ``folder``, which appears whole or not at all; an earlier run's is
    replaced.

    Raises:
        LogError: something else lies at ``folder``.
    """
    from ingest import write_log

    with run_folder(folder) as draft:
        diagnosis.samples.write_parquet(draft / SAMPLES)
        if diagnosis.signals is not None:
            diagnosis.signals.frame.write_parquet(draft / SIGNALS)
        (draft / VERDICT).write_text(to_json(diagnosis.verdict.to_json()), encoding="utf-8")
        write_log(annotated(diagnosis), draft / ANNOTATED)
        if timeline:
            from viz.timeline import write_timeline

            write_timeline(diagnosis, draft / TIMELINE)
        manifest = {**manifest, SHOWN: shown(diagnosis)}
        (draft / MANIFEST).write_text(to_json(manifest), encoding="utf-8")


def shown(diagnosis: Diagnosis) -> dict[str, Any]:
    """What pictures of the run show of its detector, for those that are made later."""
    plane, about = diagnosis.operating_map, diagnosis.about
    return {"map": plane and plane.to_json(), "about": about and about.to_json()}


@contextmanager
def run_folder(folder: Path) -> Iterator[Path]:
    """A folder to write a run to, that becomes ``folder`` if all goes well.

    Raises:
        LogError: something else lies at ``folder``.
    """
    _check(folder)
    with draft_folder(folder) as draft:
        yield draft
        put(draft, folder)


def put(draft: Path, folder: Path) -> None:
    """Rename ``draft`` to ``folder``; an earlier run that was there goes once that has worked.

    Raises:
        LogError: something else lies at ``folder``.
    """
    _check(folder)
    if not folder.exists():
        draft.rename(folder)
        return
    folder.rename(old := draft.with_name(draft.name + ".old"))
    try:
        draft.rename(folder)
    except OSError:
        old.rename(folder)
        raise
    shutil.rmtree(old)


def _check(folder: Path) -> None:
    if folder.exists() and not (folder / MANIFEST).is_file():
        raise LogError(f"{folder} exists and is not a run's folder; choose another --out")


def annotated(diagnosis: Diagnosis) -> Log:
    """The log with the samples as further groups (``residuals``, ``regime``, ``verdict``) and the findings as
    events.

    They take the place of those of an earlier run; where the log has a signal of a column's name, the column
    is called ``dynoscope.<name>``.
    """
    log = diagnosis.log
    log = replace(
        log,
        groups={k: g for k, g in log.groups.items() if k not in ADDED},
        events=tuple(e for e in log.events if e.source != "dynoscope"),
    )
    samples = diagnosis.samples
    kinds = {
        "residuals": [c for c in samples.columns if c.startswith((*MEASURED, SIGMA, MODEL_SD, "z."))],
        "verdict": [c for c in samples.columns if c.startswith(("detection", "evidence.", "p."))],
    }
    other = [c for c in samples.columns if not c.endswith((CORRECTED, CORRECTED_SD))]
    kinds["regime"] = [c for c in other if c not in (TIME, *kinds["residuals"], *kinds["verdict"])]
    taken = log.signals
    groups = {
        name: _group(
            name,
            samples.select(TIME, *columns),
            diagnosis,
            {c: f"dynoscope.{c}" for c in columns if c in taken},
        )
        for name, columns in kinds.items()
        if columns
    }
    if diagnosis.verdict.signal and (corrected := _corrected(diagnosis)):
        groups["corrected"] = corrected
    return replace(log, groups={**log.groups, **groups}).with_events(diagnosis.verdict.events)


def _corrected(diagnosis: Diagnosis) -> Group | None:
    """The readings of the isolated sensors as healthy ones would have given them."""
    group = diagnosis.signals
    columns = [n for n in group.signals if n.endswith((CORRECTED, CORRECTED_SD))] if group else []
    if group is None or not columns:
        return None
    return Group("corrected", group.frame.select(TIME, *columns), {c: group.signals[c] for c in columns})


def to_json(value: Any) -> str:
    """JSON text with one key a line; NaN is not JSON and raises."""
    return json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _group(name: str, frame: pl.DataFrame, diagnosis: Diagnosis, renamed: Mapping[str, str]) -> Group:
    signals = {}
    for c, dtype in [*frame.schema.items()][1:]:
        kind, _, residual = c.partition(".")
        unit = diagnosis.units.get(residual) if f"{kind}." in (*MEASURED, SIGMA, MODEL_SD) else "1"
        state = dtype.is_integer() or dtype == pl.Boolean
        signals[renamed.get(c, c)] = Signal(
            name=renamed.get(c, c), unit=unit, kind="state" if state else "continuous",
            resample="hold" if state else "linear",
        )  # fmt: skip
    return Group(name, frame.rename(renamed), signals)
