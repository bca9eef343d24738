"""Retraining: a challenger from new fault-free logs, and whether it may take the champion's place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ingest.errors import StoreError
from ingest.log import Log
from pipeline.comparing import compare_detectors
from pipeline.detector import Detector, new_detector
from pipeline.fitting import LEFT_OUT, fit, learn, others, sections, suspicious
from pipeline.recipe import Recipe
from pipeline.records import source
from pipeline.store import Store
from stages.continuing import continued, gather
from stages.paired import WORSE
from stages.relations import Relations
from stages.stage import transform

HELD_OUT = 0.3  # of each log, where no logs are held out
Progress = Callable[[str], None]


def split(logs: Sequence[Log]) -> tuple[list[Log], list[Log]]:
    """The logs without their last 30 %, and those parts.

    >>> split([])
    ([], [])
    """
    training, held_out = [], []
    for log in logs:
        start, end = log.span
        cut = end - HELD_OUT * (end - start)
        training.append(log.between(start, cut))
        held_out.append(log.between(cut, end))
    return training, held_out


def challenge(
    logs: Sequence[Log],
    recipe: Recipe,
    champion: Detector,
    calibrate: Sequence[Log] = (),
    progress: Progress = lambda _: None,
    *,
    trust: bool = False,
) -> Detector:
    """A challenger trained on ``logs`` from scratch.

    Raises:
        LogError, RecipeError: as :func:`pipeline.fitting.fit`.
    """
    origin = {"challenges": champion.key, "how": "from scratch"}
    return fit(logs, recipe, calibrate, progress, origin, trust)


def continue_champion(
    champion: Detector,
    logs: Sequence[Log],
    calibrate: Sequence[Log] = (),
    progress: Progress = lambda _: None,
    *,
    trust: bool = False,
) -> Detector:
    """A challenger that goes on learning from ``logs`` where the champion stopped (:mod:`stages.continuing`);
    scales, maps and selected inputs are the champion's, and without ``calibrate`` its spreads and thresholds.

    Raises:
        StoreError: the champion cannot be continued, or has learned from one of the logs already.
        LogError: too many logs look faulty, or none is left.
    """
    place = next((i for i, s in enumerate(champion.stages) if isinstance(s, Relations)), None)
    if place is None or not champion.sums:
        raise StoreError(
            f"champion {champion.key} keeps no sums that can be continued (recipe "
            f"{champion.recipe.name!r}); retrain without --warm"
        )
    _check_new(champion, logs)
    before, decide = champion.stages[:place], sections(champion.stages)[2]
    blocks = [transform(before, log) for log in logs]
    known = champion.stages[: len(champion.stages) - len(decide)]
    found = [None] * len(logs) if trust else suspicious(known, decide, blocks, place)
    notes: list[str] = []
    origin: dict[str, Any] = {"challenges": champion.key, "how": "continued"}
    if named := [f for f in found if f]:
        notes.append(LEFT_OUT + "; ".join(map(str, named)))
        progress(notes[-1])
        origin["left_out"] = [f.to_json() for f in named]
        logs, blocks = others(logs, blocks, found)
    progress(f"continuing {champion.key} with {len(logs)} log(s)")
    relations = champion.stages[place]
    assert isinstance(relations, Relations)
    sums = gather(relations, blocks, champion.sums)
    stages = [*before, continued(relations, sums), *known[place + 1 :]]
    record = champion.record
    calibration: Sequence[Any] = calibrate
    if calibrate:
        progress(f"setting spreads and thresholds on {len(calibrate)} log(s)")
        stages += learn(decide, [(stages, transform(stages, log)) for log in calibrate])
    else:
        notes.append("spreads and thresholds are the champion's; give fault-free logs with --calibrate")
        calibration, stages = record["calibration"], [*stages, *decide]
    training = [*record["training"], *map(source, logs)]
    return new_detector(champion.recipe, stages, training, calibration, notes, origin, sums)


def _check_new(champion: Detector, logs: Sequence[Log]) -> None:
    """A log may not be learned from twice.

    Raises:
        StoreError: one of them, or part of it, has been.
    """
    had = champion.record["training"]
    for log in map(source, logs):
        if any(
            log["sha256"] == old["sha256"] and log["start_s"] < old["end_s"] and old["start_s"] < log["end_s"]
            for old in had
        ):
            raise StoreError(
                f"log {log['log']!r}: champion {champion.key} has learned from it already; "
                "with --warm give new logs only"
            )


def compared(
    store: Store,
    champion: Detector,
    challenger: Detector,
    held_out: Sequence[Log],
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """The comparison on held-out logs as JSON values, kept in the store."""
    found = compare_detectors(champion, challenger, held_out, progress=progress).to_json()
    store.keep_comparison(found)
    return found


def promote(store: Store, challenger: Detector, reason: str, *, force: bool = False) -> dict[str, Any] | None:
    """Make the challenger champion, unless the comparison that the store keeps with the present champion
    says that it is worse. The comparison, None if there is none.

    Raises:
        StoreError: it is worse and not forced, or forced without a reason.
    """
    if force and not reason:
        raise StoreError("--force needs a --reason, which goes into the champion's history")
    name = challenger.recipe.name
    history = store.history(name)
    found = store.comparison(str(history[-1]["key"]), challenger.key) if history else None
    if found and found["verdict"] == WORSE and not force:
        raise StoreError(
            f"detector {challenger.key} is worse than the champion {found['champion']}: {because(found)}; "
            "keep the champion, or promote it with --force and a --reason"
        )
    said = f" (compared: {found['verdict']})" if found else ""
    store.promote(challenger.key, name, f"{reason or 'promoted'}{said}{', forced' if force else ''}")
    return found


def because(comparison: Mapping[str, Any]) -> str:
    """The deciding rows that say what the whole says.

    >>> row = {"what": "detected", "pooled": True, "verdict": "worse", "difference": -0.1, "low": -0.2,
    ...        "high": -0.05, "unit": ""}
    >>> because({"verdict": "worse", "rows": [row]})
    'detected -0.1 (-0.2 to -0.05)'
    """
    rows = [r for r in comparison["rows"] if r["pooled"] and r["verdict"] == comparison["verdict"]]
    return "; ".join(_said(r) for r in rows) or "no row decides"


def _said(row: Mapping[str, Any]) -> str:
    low, high = ("?" if row[k] is None else f"{row[k]:.2g}" for k in ("low", "high"))
    unit = f" {row['unit']}" if row["unit"] else ""
    return f"{row['what']} {row['difference']:.2g}{unit} ({low} to {high})"
