"""Proposing: which logs of a batch a retraining may learn from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ingest.errors import LogError
from ingest.files import sha256
from pipeline.outputs import MANIFEST, SAMPLES, VERDICT
from pipeline.summary import SUMMARY
from stages.gate import GATE
from stages.relations import IN_DOMAIN
from stages.results import STATISTIC

KNOWN = 0.95  # share of the steady samples in the trained domain below which operating points are new
CLEAR = -2.0  # nats: how far the largest evidence must stay below its threshold
LEAST_S = 90.0  # of usable samples
MISSING = 0.01  # share of a needed signal's samples


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """A log of a batch, whether it is proposed, and why."""

    log: str
    path: str
    proposed: bool
    why: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def propose(out: Path) -> list[Proposal]:
    """Of every log of the batch in ``out`` whether it is fit to train on: diagnosed as fault-free with enough
    usable samples and no evidence near its threshold, of good quality, and still what was read.

    Raises:
        LogError: ``out`` is not the folder of a batch.
    """
    path = out / f"{SUMMARY}.parquet"
    try:
        rows = pl.read_parquet(path).to_dicts()
    except (OSError, pl.exceptions.PolarsError) as error:
        raise LogError(f"{out} is not the folder of a batch: {path} cannot be read: {error}") from None
    return [_of(out / str(row["log"]), row) for row in rows]


def _of(folder: Path, row: dict[str, Any]) -> Proposal:
    path = ""
    try:
        if row["status"] != "failed":
            path = str(json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["log"]["path"])
        refused = _refused(folder, row)
        why = refused or _merit(pl.read_parquet(folder / SAMPLES))
    except (OSError, ValueError, KeyError, pl.exceptions.PolarsError) as error:
        refused = why = f"the run cannot be read: {error}"
    return Proposal(log=str(row["log"]), path=path, proposed=not refused, why=why)


def _refused(folder: Path, row: dict[str, Any]) -> str:
    """Why a log is not proposed; empty if it is."""
    if row["status"] != "ok":
        return f"{row['status']}: {row['reason']}"
    if row["fault"] != "none":
        return f"verdict {row['fault']}"
    if (row["usable_s"] or 0.0) < LEAST_S:
        return f"only {row['usable_s'] or 0:.0f} s of usable samples"
    manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    log, needed = manifest["log"], manifest["steps"][0]["settings"].get("signals", ())
    path = Path(log["path"])
    if not path.is_file():
        return "the log is not there any more"
    if sha256(path) != log["sha256"]:
        return "the log has changed since"
    quality = json.loads((folder / VERDICT).read_text(encoding="utf-8"))["quality"]
    known = {n: quality[n] for n in needed if n in quality}
    if bad := [n for n, q in known.items() if q.get("stuck") or (q.get("missing_share") or 0) > MISSING]:
        return f"quality of {', '.join(bad)}: stuck, or more than {100 * MISSING:g} % missing"
    samples = pl.read_parquet(folder / SAMPLES)
    if STATISTIC not in samples.columns:
        return ""
    largest = float(np.nanmax(samples[STATISTIC].fill_null(np.nan).to_numpy(), initial=-np.inf))
    return f"evidence comes within {-largest:.1f} of its threshold" if largest > CLEAR else ""


def _merit(samples: pl.DataFrame) -> str:
    """What a log adds."""
    steady = samples.filter(pl.col(GATE) >= 0.5) if GATE in samples.columns else samples
    if IN_DOMAIN not in samples.columns or not steady.height:
        return "fault-free"
    share = float(steady[IN_DOMAIN].mean() or 0.0)  # type: ignore[arg-type]
    if share >= KNOWN:
        return "fault-free, at known operating points"
    return f"fault-free, {100 * (1 - share):.0f} % at new operating points"
