"""The summary of a batch: one row per log, and what stands in ``summary.parquet`` at every moment."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from ingest.errors import LogError
from pipeline.driving_cycles import Vehicles
from pipeline.files import aside
from pipeline.fleet import fleet_table
from pipeline.outputs import MANIFEST
from pipeline.remote_out import send_files

Row = dict[str, Any]
SUMMARY_SCHEMA = {
    "log": pl.String, "status": pl.String, "reason": pl.String, "recipe": pl.String, "detector": pl.String,
    "fault": pl.String, "signal": pl.String, "set": pl.String, "p": pl.Float64, "onset_s": pl.Float64,
    "detected_s": pl.Float64, "magnitude": pl.Float64, "magnitude_sd": pl.Float64, "unit": pl.String,
    "usable_s": pl.Float64, "duration_s": pl.Float64, "truth": pl.String,
    "vehicle": pl.String, "start_time": pl.String, "cycle": pl.Int64, "fault_codes": pl.String,
    "mil": pl.Boolean,
}  # fmt: skip
SUMMARY, FLEET, VEHICLES = "summary", "fleet", "vehicles.json"
FEW = 200  # rows that are written after each log; of more, the writing takes a twentieth of the time
SHARE = 20.0


def verdict_row(name: str, verdict: Mapping[str, Any], manifest: Mapping[str, Any]) -> Row:
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
        "duration_s": manifest["log"].get("duration_s"),
        "truth": " ".join(verdict["statistics"].get("truth", [])) or None,
        "vehicle": manifest["log"].get("vehicle"),
        "start_time": manifest["log"].get("start_time"),
    }


def summary_frame(rows: Sequence[Mapping[str, Any]]) -> pl.DataFrame:
    """The summary's table; what a row does not say is null."""
    return pl.DataFrame({c: [row.get(c) for row in rows] for c in SUMMARY_SCHEMA}, schema=SUMMARY_SCHEMA)


class Summary:
    """The rows of a batch's folder ``out``: those of ``names`` in this order, then those of earlier batches.

    Of earlier batches a row stays while the log's folder does; a failed log has none. ``url``: where the
    files are to be copied.

    Raises:
        LogError: the files cannot be written.
    """

    def __init__(self, out: Path, names: Sequence[str], url: str | None = None) -> None:
        self.out, self.url = out, url
        self.names = names
        self.earlier = {row["log"]: row for row in _read(out)}
        self.rows = dict(self.earlier)
        self.vehicles = Vehicles.load(out / VEHICLES)
        self._written, self._took, self._whole = 0.0, 0.0, False

    def add(self, row: Row) -> None:
        """Take in a log's row, and write all files unless that was done a moment ago."""
        self.rows[row["log"]], self._whole = row, False
        if (len(self.rows) <= FEW and not self.url) or time.monotonic() - self._written > SHARE * self._took:
            self.write()

    def finish(self) -> None:
        """See to it that the files say all."""
        if not self._whole:
            self.write()

    def write(self) -> None:
        """Replace all files, each whole."""
        began = time.monotonic()
        frame = self.frame()
        try:
            with aside(self.out / f"{SUMMARY}.parquet") as draft:
                frame.write_parquet(draft)
            with aside(self.out / f"{SUMMARY}.csv") as draft:
                frame.write_csv(draft)
            with aside(self.out / f"{FLEET}.csv") as draft:
                fleet_table(frame).write_csv(draft)
            self.vehicles.save(self.out / VEHICLES)
        except OSError as error:
            raise LogError(
                f"the summary in {self.out} cannot be written: {error.strerror or error}"
            ) from None
        if self.url:
            send_files([f for f in self.out.iterdir() if f.is_file()], self.url)
        self._written, self._whole = time.monotonic(), True
        self._took = self._written - began

    def frame(self, only: Iterable[str] | None = None) -> pl.DataFrame:
        """The table as it stands, of all logs or of ``only`` some."""
        wanted = [n for n in self.names if n in self.rows]
        wanted += sorted(self.rows.keys() - set(wanted))
        codes = self.vehicles.judge([self.rows[n] for n in wanted])
        chosen = wanted if only is None else [n for n in only if n in self.rows]
        return summary_frame([{**self.rows[n], **codes.get(n, {})} for n in chosen])


def _read(out: Path) -> list[Row]:
    """The rows of an earlier batch that still hold; none where there is no summary that can be read."""
    try:
        frame = pl.read_parquet(out / f"{SUMMARY}.parquet")
        rows = frame.select(list(SUMMARY_SCHEMA)).cast(SUMMARY_SCHEMA).to_dicts()  # type: ignore[arg-type]
    except (OSError, pl.exceptions.PolarsError):
        return []
    return [r for r in rows if r["status"] == "failed" or (out / r["log"] / MANIFEST).is_file()]
