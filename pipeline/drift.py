"""The drift report of a batch: how the residuals have moved from drive to drive, and whether to retrain."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import LogError
from pipeline.files import aside, write_aside
from pipeline.summary import SUMMARY
from stages.drifting import Drift, drift_of
from stages.gate import GATE
from stages.relations import IN_DOMAIN, REGIME
from stages.residuals import RESIDUAL, SIGMA

Array = NDArray[np.float64]
ALL = -1  # in place of a regime
TABLE, REPORT = "drift.parquet", "drift.json"
LEAST = 5  # drives below which nothing is said
FEW = 20  # samples of a drive below which it has no mean: those before an alarm may be two or three
# when to act: share outside the trained domain, a mean's move and a spread's growth over sigma, alarms
OUTSIDE, MOVED, WIDER, ALARMS = 0.05, 0.5, 1.3, 0.2
QUIET = ("none", "insufficient_evidence")


@dataclass(frozen=True, kw_only=True)
class Advice:
    """What to do, why, and the log from which on the reason holds."""

    do: str
    why: str
    since: str


def drift_report(out: Path) -> dict[str, Any]:
    """The drift report of the runs in ``out``, as JSON values; writes it to ``drift.json`` there, and
    ``drift.parquet``, one row per log, residual and regime (-1: all) with ``n mean sd sigma outside``.

    Logs are in the order of their start times where all have one, else of the summary.

    Raises:
        LogError: there is no batch, or too few runs with residuals by regime.
    """
    rows = _runs(out)
    frames = [f for row in rows if (f := _of_run(out / row["log"], row)) is not None]
    if len(frames) < LEAST:
        raise LogError(
            f"{out}: {len(frames)} run(s) with residuals by regime are too few to see a drift; "
            f"at least {LEAST} are needed"
        )
    table = pl.concat(frames)
    kept = [row for row in rows if row["log"] in set(table["log"])]
    names = [row["log"] for row in kept]
    series = list(_series(table, names))
    advice = [*_advise(table, names, series), *_alarms(kept)]
    report = {
        "logs": names,
        "series": [{k: _plain(v) for k, v in s.items() if k != "x"} for s in series],
        "advice": [asdict(a) for a in advice],
        "retrain": any(a.do.startswith("retrain") for a in advice),
    }
    text = json.dumps(report, indent=1) + "\n"
    with aside(out / TABLE) as draft:
        table.write_parquet(draft)
    write_aside(out / REPORT, text.encode())
    return dict(json.loads(text))


def _plain(value: Any) -> Any:
    if isinstance(value, Drift):
        return asdict(value) | {"moved": value.moved}
    return value


def _runs(out: Path) -> list[dict[str, Any]]:
    """The rows of the summary that are of a run, in order of time."""
    path = out / f"{SUMMARY}.parquet"
    try:
        frame = pl.read_parquet(path)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise LogError(f"{out} is not the folder of a batch: {path} cannot be read: {error}") from None
    rows = [row for row in frame.to_dicts() if row["status"] != "failed"]
    if all(row.get("start_time") for row in rows):
        rows.sort(key=lambda row: str(row["start_time"]))
    return rows


def _of_run(folder: Path, row: dict[str, Any]) -> pl.DataFrame | None:
    """Means and spreads of a run's residuals by regime, over samples near steady state and without alarm."""
    samples = pl.read_parquet(folder / "samples.parquet")
    names = [c.removeprefix(RESIDUAL) for c in samples.columns if c.startswith(RESIDUAL)]
    if REGIME not in samples.columns or not names:
        return None
    gate = pl.col(GATE) if GATE in samples.columns else pl.lit(1.0)
    steady = samples.filter((gate >= 0.5) & (pl.col("detection") == 0))
    parts = []
    for name in names:
        e, sigma = pl.col(RESIDUAL + name), pl.col(SIGMA + name)
        known = steady.filter(e.is_finite() & sigma.is_finite() & (sigma > 0))
        w = 1 / sigma**2
        numbers = [
            pl.len().alias("n"), pl.when(pl.len() >= FEW).then((w * e).sum() / w.sum()).alias("mean"),
            e.std().alias("sd"), (1 / w.mean()).sqrt().alias("sigma"),
            (~pl.col(IN_DOMAIN)).mean().alias("outside"),
        ]  # fmt: skip
        of_each = known.group_by(REGIME).agg(numbers).sort(REGIME)
        of_all = known.select(pl.lit(ALL).alias(REGIME), *numbers)
        parts.append(pl.concat([of_all, of_each], how="vertical_relaxed").with_columns(residual=pl.lit(name)))
    return pl.concat(parts).select(
        pl.lit(row["log"]).alias("log"), pl.lit(row.get("start_time"), dtype=pl.String).alias("start_time"),
        "residual", REGIME, "n", "mean", "sd", "sigma", "outside",
    )  # fmt: skip


def _series(table: pl.DataFrame, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """For each residual, over all and by regime, the drift of its mean over the logs."""
    order = pl.DataFrame({"log": names})
    for (residual, regime), part in sorted(table.group_by("residual", REGIME), key=lambda kv: str(kv[0])):
        joined = order.join(part, on="log", how="left")
        x = joined["mean"].fill_null(np.nan).to_numpy()
        if np.isfinite(x).sum() < LEAST:
            continue
        sigma = float(joined["sigma"].median() or np.nan)  # type: ignore[arg-type]
        yield {"residual": residual, "regime": regime, "sigma": sigma, "drift": drift_of(x), "x": x}


def _advise(table: pl.DataFrame, names: Sequence[str], series: Sequence[dict[str, Any]]) -> Iterator[Advice]:
    whole = table.filter(pl.col(REGIME) == ALL)
    outside = whole.group_by("log", maintain_order=True).agg(pl.col("outside").mean())
    by_log = dict(zip(outside["log"], outside["outside"], strict=True))
    share = np.array([by_log.get(n) if by_log.get(n) is not None else np.nan for n in names], dtype=float)
    found = drift_of(share, least=OUTSIDE / 2)
    if found.segments and found.segments[-1].level > OUTSIDE:
        last = found.segments[-1]
        yield Advice(
            do="retrain with these logs, if they are fault-free",
            why=f"{100 * last.level:.0f} % of the steady samples lie outside the trained domain",
            since=names[last.first],
        )
    for s in series:
        if s["regime"] != ALL:
            continue
        drift, sigma = s["drift"], s["sigma"]
        if abs(drift.moved) > MOVED * sigma:
            last = drift.segments[-1]
            yield Advice(
                do="look for a fault or wear first; retrain if the vehicle is known to be sound",
                why=f"{s['residual']} has moved by {drift.moved:+.3g}, {abs(drift.moved) / sigma:.1f} sigma",
                since=names[last.first],
            )
        part = whole.filter(pl.col("residual") == s["residual"])
        ratio = (part["sd"] / part["sigma"]).fill_null(np.nan).to_numpy()
        late = ratio[-max(LEAST, len(ratio) // 4) :]
        if np.isfinite(late).any() and np.nanmedian(late) > WIDER:
            yield Advice(
                do="calibrate again (fit --from champion --calibrate)",
                why=f"{s['residual']} is {np.nanmedian(late):.1f} times as wide as the detector supposes",
                since=names[-len(late)],
            )


def _alarms(rows: Sequence[dict[str, Any]]) -> Iterator[Advice]:
    late = rows[-max(LEAST, len(rows) // 4) :]
    faults = [row["fault"] for row in late if row["fault"] not in QUIET]
    if len(faults) > ALARMS * len(late):
        named = max(set(faults), key=faults.count)
        yield Advice(
            do="look into the alarms; do not train on these logs",
            why=f"{len(faults)} of the last {len(late)} logs have one, most often {named}",
            since=str(late[0]["log"]),
        )
