"""What ``dynoscope view`` opens: recordings as they are, and those that are made for the occasion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import polars as pl

from ingest.errors import LogError
from ingest.files import find_logs, read_log
from ingest.log import Log
from pipeline.runs import from_annotated, is_run, read_manifest, read_run, run_folders
from pipeline.summary import SUMMARY, SUMMARY_SCHEMA, summary_frame
from pipeline.task import IN_PARTS
from pipeline.wear import wear_of_batch
from stages.results import Diagnosis

if TYPE_CHECKING:
    from pipeline.detector import Detector

Shown = Path | Log | Diagnosis
OPENED = 20
"""Recordings of a batch that are opened with its overview, those with a fault first."""
LANES = 140
"""Logs of a batch that have a lane in its overview, those with a fault first."""
QUIET = ("none", "insufficient_evidence")


def to_show(paths: Sequence[str], names: Path | None, folder: Path) -> list[Shown]:
    """What the paths name, in order: recordings, runs, batches and logs. What is made for the occasion goes
    to ``folder``: the overview of a batch; two diagnoses of one log compared; up to four logs side by side.

    Raises:
        LogError: a path is nothing of that.
    """
    found: list[Shown] = []
    for number, text in enumerate(paths):
        path = Path(text)
        runs = [] if is_run(path) else list(run_folders(path))
        if len(runs) > 1:
            found += _batch(path, runs, folder / f"overview_{number}.rrd")
        else:
            found += [_run(run) for run in runs] or list(_single(text, path, names))
    if 2 <= len(paths) <= 4:
        found = [*_together(paths, names, folder / "together.rrd"), *found]
    return found


def _single(text: str, path: Path, names: Path | None) -> Iterator[Shown]:
    from viz.viewer import holds_recordings, is_recording

    if is_run(path):
        yield _run(path)
    elif is_recording(path) or holds_recordings(path):
        yield path
    else:
        for log in find_logs([text]):
            yield _opened(read_log(log, names))


def _opened(log: Log) -> Log | Diagnosis:
    """A log, or the diagnosis that it was annotated with."""
    return from_annotated(log) or log


def _run(folder: Path) -> Shown:
    """A run's recording; where it has none, the diagnosis to make one of.

    Raises:
        LogError: it has none and its log does not fit into memory, or it is damaged.
    """
    from viz.viewer import TIMELINE_FILE

    recording = folder / TIMELINE_FILE
    if recording.is_file():
        return recording
    if read_manifest(folder).get(IN_PARTS):
        raise LogError(
            f"{folder} has no {TIMELINE_FILE}, and its log is too large to make one of what is there; run it "
            "again without --no-timeline"
        )
    return read_run(folder)


def _batch(out: Path, runs: Sequence[Path], path: Path) -> list[Shown]:
    """The overview of a batch, and some of its runs, those with a fault first."""
    from pipeline.reporting import drift_of_batch
    from viz.overview import Overviewed, write_overview

    frame = _summary(out)
    rows = {row["log"]: row for row in frame.to_dicts()}
    chosen = sorted(runs, key=lambda run: rows.get(run.name, {}).get("fault", "none") in QUIET)
    laned = {run.name for run in chosen[:LANES]}
    logs = [
        Overviewed(row=row, samples=_told(out / name) if name in laned else None)
        for name, row in rows.items()
    ]
    drift = drift_of_batch(out, list(rows.values()))
    write_overview(out.resolve().name, logs, path, min(len(chosen), OPENED), drift, wear_of_batch(out))
    return [path, *(_run(run) for run in chosen[:OPENED])]


def _summary(out: Path) -> pl.DataFrame:
    from pipeline.reporting import row_of

    try:
        return pl.read_parquet(out / f"{SUMMARY}.parquet").select(list(SUMMARY_SCHEMA))
    except (OSError, pl.exceptions.PolarsError):
        return summary_frame([row_of(folder) for folder in run_folders(out)])


def _told(folder: Path) -> pl.DataFrame | None:
    """What the overview asks of a run's samples; None where there are none."""
    try:
        return pl.scan_parquet(folder / "samples.parquet").select("time", "detection", "^p\\..*$").collect()
    except (OSError, pl.exceptions.PolarsError):
        return None


def _together(paths: Sequence[str], names: Path | None, path: Path) -> list[Shown]:
    """Two to four runs or logs in one recording; nothing where one of the paths is something else."""
    from viz.beside import write_beside, write_comparison

    shown: list[Diagnosis | Log] = []
    for text in paths:
        if is_run(Path(text)):
            shown.append(read_run(Path(text)))
        elif Path(text).is_file() and Path(text).suffix != ".rrd":
            shown.append(_opened(read_log(text, names)))
        else:
            return []
    runs = [one for one in shown if isinstance(one, Diagnosis)]
    digests = {one.log.facts.get("sha256") for one in runs}
    if len(runs) == len(shown) == 2 and len(digests) == 1 and None not in digests:
        with suppress(LogError):  # no residual in common: side by side, then
            write_comparison(runs[0], runs[1], path, _labels(*runs))
            return [path]
    write_beside(shown, path)
    return [path]


def _labels(first: Diagnosis, second: Diagnosis) -> tuple[str, str]:
    keys = [(one.verdict.detector or one.verdict.recipe)[:8] for one in (first, second)]
    return (keys[0], keys[1]) if keys[0] != keys[1] else (f"{keys[0]} (1)", f"{keys[1]} (2)")


def write_compared(champion: Detector, challenger: Detector, logs: Sequence[Log], path: Path) -> None:
    """The residuals of both detectors on the same axes, a recording a log, as one file.

    Raises:
        LogError: a log lacks a signal, or ``path`` cannot be written.
    """
    from pipeline.diagnosing import diagnose
    from viz.beside import write_comparison
    from viz.viewer import check_folder, merge

    check_folder(path)
    with TemporaryDirectory(prefix="dynoscope-") as folder:
        parts = [Path(folder) / f"{number}.rrd" for number in range(len(logs))]
        for log, part in zip(logs, parts, strict=True):
            both = diagnose(log, champion), diagnose(log, challenger)
            write_comparison(*both, part, ("champion", "challenger"))
        merge(parts, path)


def layers(shown: Sequence[Shown], runs: Sequence[Path], folder: Path) -> list[Shown]:
    """Layers of ``runs`` for the first recording shown, written to ``folder``.

    Raises:
        LogError: nothing shown is a recording, or one of ``runs`` is not a run.
    """
    from viz.layers import write_layer

    if not runs:
        return []
    base = next((one for one in shown if isinstance(one, Path) and one.is_file()), None)
    if base is None:
        raise LogError(
            "--layer: nothing to add it to; name a run that has its timeline.rrd (run without --no-timeline)"
        )
    made: list[Shown] = []
    for number, run in enumerate(runs):
        diagnosis = read_run(run)
        path = folder / f"layer_{number}.rrd"
        label = (diagnosis.verdict.detector or diagnosis.verdict.recipe)[:8]
        write_layer(diagnosis, base, path, label)
        made.append(path)
    return made
