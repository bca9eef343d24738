"""Replay regression: a stored set of logs, replayed, gives what it gave when its outputs were stored.

A set is a folder with ``set.toml``::

    recipe = "diesel_airpath"
    training = ["healthy.parquet"]      # in the folder, as all logs
    calibration = ["other.parquet"]
    logs = ["faulty.parquet"]

and ``expected/<log>.parquet`` and ``.json``: all columns after the last stage, and the verdict. The detector
is fitted anew, so a change of fitting shows, too. Differences are told stage by stage in their order: the
first one that differs is where to look.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ingest import read_log
from ingest.errors import LogError
from ingest.log import TIME, Log
from pipeline.detector import Detector, unfitted_detector
from pipeline.diagnosing import judge, samples_table
from pipeline.files import aside, write_aside
from pipeline.fitting import fit
from pipeline.outputs import to_json
from pipeline.recipe import load_recipe
from stages.stage import ANALYSIS, transform

SET = "set.toml"
# by stage, of a column's largest value: what another machine's arithmetic may do; whole numbers are exact
TOLERANCE = {
    "relations": 1e-4,
    "narx": 1e-4,
    "residuals": 1e-3,
    "detect": 1e-3,
    "isolate": 1e-2,
    "pairs": 1e-2,
    "sensors": 1e-2,
    "monitor": 1e-3,
}
LEAST = 1e-5  # of all other stages; values are stored with seven digits


@dataclass(frozen=True, kw_only=True)
class Difference:
    """A column, or an entry of the verdict, that is not what it was; ``time`` in s of the first of ``count``
    differing rows."""

    log: str
    stage: str
    signal: str
    count: int
    time: float | None
    was: Any
    now: Any

    def __str__(self) -> str:
        if self.time is None:
            return f"{self.log}: {self.stage}: {self.signal}: {_shown(self.was)} -> {_shown(self.now)}"
        return (
            f"{self.log}: {self.stage}: {self.signal}: {self.count} difference(s), first at "
            f"{self.time:g} s: {_shown(self.was)} -> {_shown(self.now)}"
        )


def _shown(value: Any) -> str:
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def check(folder: Path) -> list[Difference]:
    """What differs from the stored outputs, log by log and stage by stage.

    Raises:
        LogError: the set, one of its logs or an expected output is missing or cannot be read.
    """
    found: list[Difference] = []
    for name, detector, block, verdict in _replayed(folder):
        try:
            expected = pl.read_parquet(folder / "expected" / f"{name}.parquet")
            said = json.loads((folder / "expected" / f"{name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, pl.exceptions.PolarsError) as error:
            raise LogError(
                f"replay set {folder}: the expected output of {name} cannot be read: {error}; "
                "store it with --update"
            ) from None
        found += _columns(name, detector, expected, block.groups[ANALYSIS].frame)
        found += _entries(name, said, verdict)
    return found


def update(folder: Path) -> list[str]:
    """Store what the set gives now; the names of its logs.

    Raises:
        LogError: the set or one of its logs cannot be read.
    """
    names = []
    for name, _, block, verdict in _replayed(folder):
        with aside(folder / "expected" / f"{name}.parquet") as draft:
            _stored(block.groups[ANALYSIS].frame).write_parquet(draft, compression_level=19)
        write_aside(folder / "expected" / f"{name}.json", to_json(verdict).encode())
        names.append(name)
    return names


def _replayed(folder: Path) -> Iterator[tuple[str, Detector, Log, dict[str, Any]]]:
    """The logs of a set after all stages, and their verdicts."""
    try:
        said = tomllib.loads((folder / SET).read_text(encoding="utf-8"))
        recipe = load_recipe(said["recipe"])
        paths = {k: [folder / p for p in said.get(k, [])] for k in ("training", "calibration", "logs")}
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise LogError(f"replay set {folder}: {SET} cannot be read: {error!r}") from None
    logs = {k: [read_log(path) for path in listed] for k, listed in paths.items()}
    if logs["training"]:
        detector = fit(logs["training"], recipe, logs["calibration"])
    else:
        detector = unfitted_detector(recipe)
    for log in logs["logs"]:
        block = transform(detector.stages, log)
        verdict = judge(log, samples_table(block.groups[ANALYSIS].frame), detector, {}).to_json()
        yield log.name, detector, block, {k: v for k, v in verdict.items() if k != "detector"}


def _stored(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(pl.col(pl.Float64).exclude(TIME).cast(pl.Float32))


def _columns(log: str, detector: Detector, was: pl.DataFrame, now: pl.DataFrame) -> Iterator[Difference]:
    """Differences of columns, in the order of the stages that add them."""
    if was.height != now.height or not was[TIME].equals(now[TIME]):
        yield Difference(
            log=log, stage=detector.recipe.uses[0], signal="rows", count=abs(was.height - now.height),
            time=None, was=was.height, now=now.height,
        )  # fmt: skip
        return
    told: set[str] = {TIME}
    every = list(dict.fromkeys([*now.columns, *was.columns]))
    for use, stage in zip(detector.recipe.uses, detector.stages, strict=True):
        for column in [c for c in every if c in stage.adds and c not in told]:
            told.add(column)
            yield from _column(log, use, column, was, now)
    for column in [c for c in now.columns if c not in told]:
        told.add(column)
        yield from _column(log, detector.recipe.uses[-1], column, was, now)
    for column in [c for c in was.columns if c not in told]:
        yield Difference(log=log, stage="?", signal=column, count=1, time=None, was="there", now="missing")


def _column(log: str, use: str, column: str, was: pl.DataFrame, now: pl.DataFrame) -> Iterator[Difference]:
    if column not in was.columns or column not in now.columns:
        there = ("there", "missing") if column in was.columns else ("missing", "there")
        yield Difference(log=log, stage=use, signal=column, count=1, time=None, was=there[0], now=there[1])
        return
    if not (was[column].dtype.is_numeric() or was[column].dtype == pl.Boolean):
        return
    a, b = (f[column].cast(pl.Float64).fill_null(np.nan).to_numpy() for f in (was, now))
    tolerance = TOLERANCE.get(use, LEAST) if was[column].dtype.is_float() else 0.0
    scale = float(np.max(np.abs(a[np.isfinite(a)]), initial=0.0))
    same = np.isclose(b, a, rtol=tolerance, atol=tolerance * min(scale, 1e6), equal_nan=True)
    rows = np.flatnonzero(~same)
    if rows.size:
        i = int(rows[0])
        yield Difference(
            log=log, stage=use, signal=column, count=int(rows.size), time=float(now[TIME][i]),
            was=float(a[i]), now=float(b[i]),
        )  # fmt: skip


def _entries(log: str, was: Any, now: Any, path: str = "") -> Iterator[Difference]:
    """Differences of a verdict's entries; numbers may differ by 1 %."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        for key in sorted({*was, *now}):
            yield from _entries(log, was.get(key), now.get(key), f"{path}.{key}".strip("."))
        return
    if isinstance(was, list | tuple) and isinstance(now, list | tuple) and len(was) == len(now):
        for i, (a, b) in enumerate(zip(was, now, strict=True)):
            yield from _entries(log, a, b, f"{path}[{i}]")
        return
    numbers = [isinstance(x, int | float) and not isinstance(x, bool) for x in (was, now)]
    same = bool(np.isclose(now, was, rtol=1e-2, atol=1e-3)) if all(numbers) else was == now
    if not same:
        yield Difference(log=log, stage="verdict", signal=path, count=1, time=None, was=was, now=now)
