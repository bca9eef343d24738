"""Diagnosing one log: through the stages of a detector, to samples and a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from ingest.log import TIME, Group, Log
from pipeline.describing import about
from pipeline.detector import Detector
from pipeline.recipe import Recipe
from stages.accommodate import accommodate
from stages.gate import GATE
from stages.hypotheses import Hypothesis
from stages.isolate import Isolate
from stages.monitor import INDICATOR, NOISE, SIGNALS
from stages.narx import Narx
from stages.pairs import Pairs
from stages.rarer import Also
from stages.relations import IN_DOMAIN, REGIME, Relations
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA, Z
from stages.results import (
    DETECTABLE,
    DETECTION,
    EVIDENCE,
    EXPECTED,
    EXPECTED_SD,
    OF,
    PAIR,
    PROBABILITY,
    SENSOR,
    SIZE,
    SIZE_SD,
    STATISTIC,
    Diagnosis,
    OperatingMap,
    Verdict,
)  # fmt: skip
from stages.stage import ANALYSIS, transform
from stages.verdict import Judge, Table

KINDS = (
    RESIDUAL, INDICATOR, SIGMA, Z, MODEL_SD, EVIDENCE, PROBABILITY, SIZE, SIZE_SD, SENSOR, EXPECTED,
    EXPECTED_SD, DETECTABLE,
)  # fmt: skip


def diagnose(
    log: Log, detector: Detector, *, quality: Mapping[str, Any] | None = None, block_s: float | None = None
) -> Diagnosis:
    """What ``detector`` says about ``log``; ``block_s`` bounds memory and changes nothing else.

    Raises:
        LogError: the log lacks a signal that the recipe needs.
    """
    return concluded(log, detector, transform(detector.stages, log, block_s), quality or {})


def concluded(log: Log, detector: Detector, block: Log, quality: Mapping[str, Any]) -> Diagnosis:
    """The diagnosis of ``log`` from what the detector's stages made of the whole of it."""
    samples = samples_table(block.groups[ANALYSIS].frame)
    verdict = judge(log, samples, detector, quality)
    signals = block.groups.get(SIGNALS) or corrected(log, samples, verdict, detector)
    return Diagnosis(
        log=log, samples=samples, verdict=verdict, units=residual_units(block),
        operating_map=operating_map(detector, block), signals=signals, about=about(detector),
    )  # fmt: skip


def corrected(log: Log, samples: pl.DataFrame, verdict: Verdict, detector: Detector) -> Group | None:
    """The isolated sensors' readings, raw and corrected, at the first one's rate (a second of another rate is
    left out); None where none was isolated."""
    hypotheses, rare = supposed(detector.recipe), rarer(detector.recipe)
    signals = verdict.signal.split(PAIR) if verdict.signal else []
    found = [accommodate(log, samples, signal, hypotheses, rare) for signal in signals]
    groups = [g for g in found if g is not None]
    if not groups:
        return None
    first = groups[0]
    alike = [g for g in groups if np.array_equal(g.time, first.time)]
    frame = pl.concat([first.frame, *(g.frame.drop(TIME) for g in alike[1:])], how="horizontal")
    return Group(first.name, frame, {name: s for g in alike for name, s in g.signals.items()})


def supposed(recipe: Recipe) -> dict[str, Hypothesis]:
    """The hypotheses of a recipe's isolation, by fault."""
    return {f: h for s in recipe.stages if isinstance(s, Isolate) for f, h in s.hypotheses.items()}


def rarer(recipe: Recipe) -> Also:
    """The hypotheses of a recipe's rarer faults, by fault and signal."""
    return {f: some for s in recipe.stages if isinstance(s, Pairs) for f, some in s.also.items()}


def judge(log: Log, samples: Table, detector: Detector, quality: Mapping[str, Any]) -> Verdict:
    """The verdict on ``log``, of which only events and facts count, in the words of the detector's recipe."""
    recipe = detector.recipe
    hypotheses = supposed(recipe)
    channels = {f: h.signal for f, h in hypotheses.items() if h.signal} | dict(recipe.channels)
    units = {f: h.unit for f, h in hypotheses.items()}
    units |= {f + OF + s: h.unit for f, some in rarer(recipe).items() for s, h in some.items()}
    alike = tuple(group for s in recipe.stages if isinstance(s, Pairs) for group in s.alike)
    words = Judge(min_evidence_s=recipe.min_evidence_s, channels=channels, units=units, alike=alike)
    return words.verdict(log, samples, recipe=recipe.name, detector=detector.key, quality=quality)


def residual_units(block: Log) -> dict[str, str]:
    """Units of a block's residuals or indicators."""
    return {
        n.partition(".")[2]: s.unit or ""
        for n, s in block.groups[ANALYSIS].signals.items()
        if n.startswith((RESIDUAL, INDICATOR))
    }


def samples_table(frame: pl.DataFrame) -> pl.DataFrame:
    """The columns of ``samples.parquet``, from all that the stages left behind."""
    head = [c for c in (REGIME, IN_DOMAIN, GATE, STATISTIC, NOISE, DETECTION) if c in frame.columns]
    kinds = [c for kind in KINDS for c in frame.columns if c.startswith(kind)]
    return frame.select(TIME, *head, *kinds)


def _label(block: Log, name: str) -> str:
    unit = block.signals[name].unit
    return f"{name} [{unit}]" if unit else name


def operating_map(detector: Detector, block: Log) -> OperatingMap | None:
    """The detector's map of regimes with the points of a block of its stages' output; None without one."""
    relations = next((s for s in detector.stages if isinstance(s, Relations | Narx)), None)
    if relations is None:
        return None
    models = relations.fitted if isinstance(relations, Narx) else relations.models
    x, y = relations.map
    learned, frame = relations.learned, block.groups[ANALYSIS].frame

    def values(column: str) -> Any:
        return frame[column].cast(pl.Float64).fill_null(np.nan).to_numpy()

    return OperatingMap(
        x_label=_label(block, x), y_label=_label(block, y), x=values(x), y=values(y),
        nodes=learned["map/nodes"], edges=models[relations.regime].partition.edges,
        visits=learned["map/visits"], spread=learned["map/spread"],
    )  # fmt: skip
