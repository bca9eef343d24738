"""Adapting: a vehicle's drives in order, its wear followed, faults told from it (:mod:`stages.adapt`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import Log
from pipeline.detector import Detector
from pipeline.guarding import directions_of, drive_means, size_of, steady_rows
from stages.adapt import Settings, Wear, commission, follow
from stages.formula import Formula
from stages.hypotheses import Hypothesis, Points
from stages.isolate import Isolate
from stages.poison import LEAST, Drives
from stages.relations import NOVELTY, REGIME, Relations
from stages.stage import ANALYSIS, add_columns, columns, transform
from stages.witness import contradiction, swear_in

Array = NDArray[np.float64]
COMMISSIONING = 10  # drives


@dataclass(frozen=True, kw_only=True, eq=False)
class Observer:
    """What a detector says of drives: their region means, and the shifts of faults and wears."""

    detector: Detector
    directions: Sequence[tuple[str, Hypothesis]]
    points: Points
    isolate: Isolate
    place: int
    regions: int

    @classmethod
    def of(cls, detector: Detector) -> Observer:
        """Raises:
        RecipeError: the recipe does not isolate, or names no wear."""
        place = next((i for i, s in enumerate(detector.stages) if isinstance(s, Isolate)), None)
        relations = next((s for s in detector.stages if isinstance(s, Relations)), None)
        if place is None or relations is None or not detector.recipe.wear:
            raise RecipeError(
                f"recipe {detector.recipe.name!r} cannot follow wear: it needs a stage `isolate` and kinds "
                "of [wear.<name>] with residuals, per_100 and total"
            )
        isolate = detector.stages[place]
        assert isinstance(isolate, Isolate)
        isolate = isolate.connect(detector.stages[:place])
        points, directions = isolate.points, directions_of(isolate)
        reduced = Points([h for _, h in directions], points.chain, points.residuals)
        regions = len(relations.models[relations.regime].theta)
        return cls(
            detector=detector, directions=directions, points=reduced, isolate=isolate, place=place,
            regions=regions,
        )  # fmt: skip

    @property
    def wears(self) -> list[Wear]:
        return [*self.detector.recipe.wear.values()]

    def block(self, log: Log) -> Log:
        """A log before the isolation; rows beyond the trained domain are in regions of their own."""
        block = transform(self.detector.stages[: self.place], log)
        block = Log(block.name, {ANALYSIS: block.groups[ANALYSIS]}, (), block.facts)
        values = columns(block)
        known = values[REGIME] >= 0
        novelty = values[self._regime + NOVELTY]
        regime = values[REGIME] + self.regions * (novelty > 1)
        return add_columns(block, {REGIME: np.where(known, regime, -1).astype(np.int32)})

    @property
    def _regime(self) -> str:
        return next(s.regime for s in self.detector.stages if isinstance(s, Relations))

    def drives(self, blocks: Sequence[Log]) -> tuple[Drives, Array]:
        """Region means of drives that have passed :meth:`block`, and of what one unit of each wear adds,
        (drives, wears, residuals, regions)."""
        given = np.array([self.isolate.offsets.get(r, {}).get("1", 0.0) for r in self.points.residuals])
        M = 2 * self.regions
        drives = drive_means(blocks, self.points, given, self.isolate.correlation_s, M)
        shift = np.zeros((len(blocks), len(self.wears), len(self.points.residuals), M))
        for k, block in enumerate(blocks):
            values = columns(block)
            rows, weight = steady_rows(values)
            scope = {c: x[rows] for c, x in values.items()}
            unit = scope[REGIME].astype(int)
            mass = np.maximum(np.bincount(unit, weight, minlength=M), 1e-12)
            for i, wear in enumerate(self.wears):
                for residual, text in wear.residuals.items():
                    x = np.nan_to_num(np.broadcast_to(Formula(text)(scope), unit.shape))
                    r = self.points.residuals.index(residual)
                    shift[k, i, r] = np.bincount(unit, weight * x, minlength=M) / mass
        return drives, shift


def adapt(
    logs: Sequence[Log],
    detector: Detector,
    commissioning: int = COMMISSIONING,
    settings: Settings | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """The wear of a vehicle over its logs, in their order, and what is no wear, as JSON values. The first
    ``commissioning`` logs are the reference; a fault in them is invisible.

    Raises:
        RecipeError: the recipe cannot follow wear.
        LogError: too few logs.
    """
    observer = Observer.of(detector)
    if commissioning < LEAST or len(logs) <= commissioning:
        raise LogError(
            f"{len(logs)} logs with a commissioning of {commissioning}: at least {LEAST} are needed for the "
            "reference, and one beyond it"
        )
    blocks = []
    for log in logs:
        blocks.append(observer.block(log))
        progress(log.name)
    drives, shift = observer.drives(blocks)
    every = np.arange(len(logs))
    state = commission(drives.but(every[:commissioning]), shift[:commissioning], observer.wears)
    later = drives.but(every[commissioning:])
    settings = settings or Settings()
    _, seen = follow(state, later, shift[commissioning:], observer.wears, settings)
    names = [*detector.recipe.wear]
    denied = denials(detector, blocks, commissioning, np.array([s.wear for s in seen]))
    rows = [
        {
            "log": log.name, "T": s.T, "alarm": s.alarm, "learned": s.learned, "denial": z,
            "faults": _named(observer, s.faults),
            "wear": {n: {"value": v, "sd": sd} for n, v, sd in zip(names, s.wear, s.wear_sd, strict=True)},
        }
        for log, s, z in zip(logs[commissioning:], seen, denied, strict=True)
    ]  # fmt: skip
    budgets = {
        n: {"per_100_drives": w.per_100, "total": w.total, "unit": w.unit}
        for n, w in detector.recipe.wear.items()
    }
    vehicles = sorted({str(v) for log in logs if (v := log.facts.get("vehicle"))})
    return {
        "vehicle": ", ".join(vehicles) or None, "detector": detector.key, "commissioning": commissioning,
        "threshold": settings.threshold, "budgets": budgets, "drives": rows,
    }  # fmt: skip


def denials(
    detector: Detector, blocks: Sequence[Log], commissioning: int, levels: Array
) -> list[float] | list[None]:
    """How far the recipe's witness contradicts the wear ``levels`` (drives, wears) after the commissioning,
    in standard deviations; None each without a witness, or where the logs lack its signals."""
    witness, values = detector.recipe.witness, [columns(block) for block in blocks]
    sworn = swear_in(witness, values[:commissioning]) if witness else None
    if witness is None or sworn is None:
        return [None] * len(levels)
    left = np.array([sworn.mean(v) for v in values[commissioning:]])
    expected = levels @ [witness.wear.get(name, 0.0) for name in detector.recipe.wear]
    return [float(z) for z in contradiction(left, expected, sworn.sd, sworn.drives, witness.inexact)]


def _named(observer: Observer, faults: Mapping[int, float]) -> dict[str, float]:
    """Faults by name with their sizes in the hypothesis's own unit, the likeliest first."""
    named: dict[str, float] = {}
    for place, times in faults.items():
        name, direction = observer.directions[place]
        named.setdefault(name, size_of(direction, times))
    return named
