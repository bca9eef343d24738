"""The static report of a batch's folder, from what its runs left there."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from ingest.errors import LogError
from pipeline.drift import ALL, TABLE
from pipeline.drift import REPORT as DRIFT
from pipeline.files import write_aside
from pipeline.fleet import fleet_table
from pipeline.outputs import MANIFEST, SHOWN, VERDICT
from pipeline.runs import is_run, read_run
from pipeline.summary import SUMMARY, SUMMARY_SCHEMA, Row, summary_frame, verdict_row
from pipeline.task import IN_PARTS
from pipeline.wear import wear_of_batch
from stages.results import Chosen

if TYPE_CHECKING:
    from viz.drift import Drifted

REPORT = "report.html"
DRAWN = 40
"""Logs that are drawn unless told otherwise: a batch of any size stays a page that a browser can hold."""
Progress = Callable[[str], None]


def write_report(out: Path, drawn: int = DRAWN, progress: Progress = lambda word: None) -> Path:
    """Write ``OUT/report.html`` for a batch's folder or a run's; it appears whole or not at all.

    All logs are in its table. At most ``drawn`` have a section of their own, those with a fault first; a
    section of the same run is taken from the report that is there.

    Raises:
        LogError: ``out`` holds neither a summary nor a run, or the report cannot be written.
    """
    from viz.report import report, section, sections

    rows = _rows(out)
    path = out / REPORT
    chosen = [r for r in sorted(rows, key=_rank) if r["status"] != "failed" and is_run(_folder(out, r))]
    had = {(s.log, s.key): s for s in sections(_text(path))}
    made, notes = [], []
    selections: tuple[Chosen, ...] = ()
    for row in chosen[:drawn]:
        folder = _folder(out, row)
        try:
            manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
            about = (manifest.get(SHOWN) or {}).get("about") or {}
            selections = selections or tuple(map(Chosen.from_json, about.get("selections", ())))
            if (found := had.get((row["log"], manifest["key"]))) is None:
                found = section(read_run(folder, values=not manifest.get(IN_PARTS)), manifest["key"])
            made.append(found)
        except Exception as error:  # whatever it is, the others are not to suffer
            reason = str(error) if isinstance(error, LogError) else f"{type(error).__name__}: {error}"
            notes.append(f"{row['log']} is not drawn: {reason}")
        progress(f"drawn {row['log']}")
    if len(chosen) > drawn:
        notes.append(
            f"{drawn} of {len(chosen)} logs are drawn, those with a fault first; more with "
            f"`dynoscope report {out.name} --drawn N`."
        )
    made.sort(key=lambda s: [r["log"] for r in rows].index(s.log))
    fleet, drift = fleet_table(summary_frame(rows)), drift_of_batch(out, rows)
    text = report(_title(rows, out), rows, made, fleet, notes, selections, drift, wear_of_batch(out))
    try:
        write_aside(path, text.encode())
    except OSError as error:
        raise LogError(f"cannot write {path}: {error.strerror or error}") from None
    return path


def drift_of_batch(out: Path, rows: Sequence[Row]) -> Drifted | None:
    """What ``dynoscope drift`` has found in the batch, to be drawn; None where it was not asked.

    Raises:
        LogError: its files are damaged.
    """
    from viz.drift import Drifted, Moved

    if not (out / DRIFT).is_file():
        return None
    try:
        told = json.loads((out / DRIFT).read_text(encoding="utf-8"))
        whole = pl.read_parquet(out / TABLE).filter(pl.col("regime") == ALL)
        order = pl.DataFrame({"log": told["logs"]})
        moved = []
        for one in (s for s in told["series"] if s["regime"] == ALL):
            found = order.join(whole.filter(pl.col("residual") == one["residual"]), on="log", how="left")
            drift = one["drift"]
            moved.append(
                Moved(
                    residual=one["residual"], means=found["mean"].fill_null(float("nan")).to_numpy(),
                    sigma=one["sigma"], noise=drift["noise"], noticed=drift["noticed"],
                    levels=tuple((s["first"], s["last"], s["level"]) for s in drift["segments"]),
                )
            )  # fmt: skip
        vehicle = {row["log"]: row["vehicle"] for row in rows}
        return Drifted(
            vehicles=tuple(vehicle.get(n) for n in told["logs"]), moved=tuple(moved),
            advice=tuple(f"since {a['since']}: {a['why']}: {a['do']}" for a in told["advice"]),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, pl.exceptions.PolarsError) as error:
        raise LogError(
            f"the drift report in {out} cannot be read ({error}); make it again with `dynoscope drift {out}`"
        ) from None


def _rows(out: Path) -> Sequence[Row]:
    try:
        return pl.read_parquet(out / f"{SUMMARY}.parquet").select(list(SUMMARY_SCHEMA)).to_dicts()
    except (OSError, pl.exceptions.PolarsError) as error:
        if is_run(out):
            return summary_frame([row_of(out)]).to_dicts()
        raise LogError(
            f"{out} is not the folder of a batch: {SUMMARY}.parquet is missing or damaged ({error}); "
            "expected what `dynoscope run LOG... --out OUT` has written"
        ) from None


def row_of(folder: Path) -> dict[str, Any]:
    """A run's row of the summary, from its own files."""
    verdict, manifest = (json.loads((folder / n).read_text(encoding="utf-8")) for n in (VERDICT, MANIFEST))
    return verdict_row(folder.name, verdict, manifest) | {"recipe": verdict["recipe"]}


def _folder(out: Path, row: Row) -> Path:
    return out / row["log"] if (out / row["log"]).is_dir() else out


def _rank(row: Row) -> tuple[int, str]:
    """Wrong verdicts and faults first, then what is in doubt, then the quiet ones."""
    if row["fault"] not in ("none", "insufficient_evidence"):
        return 0, row["log"]
    return 1 if row["fault"] == "insufficient_evidence" else 2, row["log"]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return ""


def _title(rows: Sequence[Row], out: Path) -> str:
    recipes = sorted({r["recipe"] for r in rows if r["recipe"]})
    return f"{out.resolve().name}: {len(rows)} log{'s' * (len(rows) != 1)}, recipe {', '.join(recipes)}"
