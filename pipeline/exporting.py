"""A run's annotated signals for other tools: the log's own and, beside them, residuals, regime, verdict."""

from __future__ import annotations

from pathlib import Path

from ingest.blocks import follow
from ingest.errors import LogError
from ingest.files import read_blocks
from ingest.log import Log
from ingest.recording import recording
from pipeline.outputs import ANNOTATED

FORMATS = ("mf4", "csv", "parquet")


def export_run(folder: Path, to: str, path: Path | None = None) -> Path:
    """Write ``annotated.<to>`` into the run's folder, or ``path``; it appears whole or not at all.

    Reading the file gives the annotated log back: groups, values, units, events (CSV: all but the types). It
    is read part by part; MDF4 and CSV hold it in memory until it is written.

    Raises:
        LogError: ``folder`` is not a run's, or the file cannot be written.
    """
    source = folder / ANNOTATED
    if not source.is_file():
        raise LogError(f"{folder} holds no {ANNOTATED}; expected OUT/<log> of `dynoscope run ... --out OUT`")
    path = path or source.with_suffix(f".{to}")
    parts = iter(read_blocks(source))
    first = next(parts)
    whole: Log = first
    with recording(path, first) as recorder:
        recorder.add(first)
        for part in parts:
            recorder.add(part)
            whole = follow(whole, part)
        recorder.finish(follow(whole, whole), {})
    return path
