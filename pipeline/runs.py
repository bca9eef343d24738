"""Runs read back: the folder that :mod:`pipeline.outputs` left, as the diagnosis it was made of."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from ingest.errors import LogError
from ingest.files import read_header, read_log
from ingest.log import TIME, Group, Log, Signal
from pipeline.outputs import ADDED, ANNOTATED, MANIFEST, MEASURED, SAMPLES, SHOWN, SIGNALS, VERDICT
from pipeline.samples import thinned
from stages.results import About, Diagnosis, OperatingMap, Verdict
from viz.series import at_times

OURS = "dynoscope."  # before a column whose name the log has too
TOLD = ("residuals", "regime", "verdict")
# what reading a damaged file raises
DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, pl.exceptions.PolarsError)


def is_run(folder: Path) -> bool:
    """Whether ``folder`` is what a run left for a log."""
    return all((folder / name).is_file() for name in (SAMPLES, VERDICT, ANNOTATED, MANIFEST))


def run_folders(out: Path) -> Iterator[Path]:
    """The runs in a batch's folder, in order of their names."""
    for manifest in sorted(out.glob(f"*/{MANIFEST}")):
        if is_run(manifest.parent):
            yield manifest.parent


def read_manifest(folder: Path) -> dict[str, Any]:
    """A run's manifest.

    Raises:
        LogError: it is not there or damaged.
    """
    try:
        return dict(json.loads((folder / MANIFEST).read_text(encoding="utf-8")))
    except DAMAGE as error:
        raise LogError(
            f"{folder} is not a run's folder ({error}); expected `dynoscope run ... --out`'s <log>/"
        ) from None


def read_run(folder: Path, *, values: bool = True) -> Diagnosis:
    """The diagnosis of a run; without ``values`` the log has its signals, events and facts but no rows, and
    of many samples there are some, evenly taken.

    Raises:
        LogError: the folder is not a run's, or a file in it is damaged.
    """
    manifest = read_manifest(folder)
    try:
        verdict = Verdict.from_json(json.loads((folder / VERDICT).read_text(encoding="utf-8")))
        samples = pl.read_parquet(folder / SAMPLES) if values else thinned(folder / SAMPLES)[0]
        whole = (read_log if values else read_header)(folder / ANNOTATED)
        log = _as_read(whole, verdict.log)
        return Diagnosis(
            log=log, samples=samples, verdict=verdict, units=_units(whole),
            operating_map=_operating_map(manifest.get(SHOWN) or {}, log, samples),
            signals=_signals(folder / SIGNALS, whole), about=_about(manifest.get(SHOWN) or {}),
        )  # fmt: skip
    except DAMAGE as error:
        raise LogError(f"{folder}: damaged ({type(error).__name__}: {error}); run its log again") from None


def from_annotated(annotated: Log) -> Diagnosis | None:
    """The diagnosis that an annotated log carries: its samples, and of the verdict what its events say; None
    where it carries none."""
    parts = [annotated.groups[name].frame for name in TOLD if name in annotated.groups]
    rasters = {(*frame[TIME].head(2), frame.height) for frame in parts}
    if not parts or len(rasters) != 1 or not any("detection" in frame.columns for frame in parts):
        return None
    samples = pl.concat([parts[0], *(frame.drop(TIME) for frame in parts[1:])], how="horizontal")
    samples = samples.rename({c: c.removeprefix(OURS) for c in samples.columns if c.startswith(OURS)})
    log = _as_read(annotated, annotated.name)
    events = tuple(e for e in annotated.events if e.source == "dynoscope")
    strongest = max(events, key=lambda e: e.confidence or 0.0, default=None)
    alarm = samples.filter(pl.col("detection") > 0)
    verdict = Verdict(
        log=log.name, recipe="annotated log", detector=None, fault=strongest.kind if strongest else "none",
        signal=strongest.channel if strongest else None, onset_s=strongest.t_start if strongest else None,
        detected_s=float(alarm[TIME][0]) if alarm.height else None, events=events,
        probability={strongest.kind: strongest.confidence or 0.0} if strongest else {},
    )  # fmt: skip
    return Diagnosis(
        log=log, samples=samples, verdict=verdict, units=_units(annotated),
        signals=annotated.groups.get("corrected"),
    )  # fmt: skip


def _as_read(annotated: Log, name: str) -> Log:
    """The log as it was before it was annotated."""
    return replace(
        annotated,
        name=name,
        groups={k: g for k, g in annotated.groups.items() if k not in ADDED},
        events=tuple(e for e in annotated.events if e.source != "dynoscope"),
    )


def _units(annotated: Log) -> dict[str, str]:
    group = annotated.groups.get("residuals")
    signals = group.signals if group else {}
    return {
        name.partition(".")[2]: signal.unit or ""
        for name, signal in ((n.removeprefix("dynoscope."), s) for n, s in signals.items())
        if name.startswith(MEASURED)
    }


def _operating_map(shown: Mapping[str, Any], log: Log, samples: pl.DataFrame) -> OperatingMap | None:
    found = shown.get("map")
    if not found:
        return None
    names = (found[label].split(" [")[0] for label in ("x_label", "y_label"))
    x, y = (at_times(log, name, samples[TIME].to_numpy()) for name in names)
    return OperatingMap.from_json(found, x, y)


def _about(shown: Mapping[str, Any]) -> About | None:
    found = shown.get("about")
    return About.from_json(found) if found else None


def _signals(path: Path, annotated: Log) -> Group | None:
    if not path.is_file():
        return None
    frame, known = pl.read_parquet(path), annotated.signals
    units = {c: known[base].unit for c in frame.columns[1:] if (base := c.split(".corrected")[0]) in known}
    return Group("signals", frame, {c: Signal(name=c, unit=units.get(c)) for c in frame.columns[1:]})
