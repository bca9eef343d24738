"""Guarding a fit: which of its logs look as if a fault were in them, by :mod:`stages.poison`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import LogError
from ingest.log import TIME, Log
from stages.gate import GATE
from stages.hypotheses import Hypothesis, Points
from stages.isolate import Isolate
from stages.poison import LEAST, Drives, suspicious
from stages.relations import REGIME
from stages.stage import ANALYSIS, Stage, columns

Array = NDArray[np.float64]
MOST = 0.4  # share of suspicious logs above which nobody can say which are the healthy ones
ROWS = 600  # of a log that are looked at
STEADY = 0.5  # gate of a sample that counts


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A suspicious log: the fault that fits it best, its size, and the evidence T."""

    log: str
    fault: str
    size: float
    unit: str
    evidence: float

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.log} ({self.fault} {self.size:+.2g}{unit}, evidence {self.evidence:.0f})"

    def to_json(self) -> dict[str, Any]:
        return {"log": self.log, "fault": self.fault, "size": float(f"{self.size:.4g}"), "unit": self.unit,
                "evidence": float(f"{self.evidence:.4g}")}  # fmt: skip


def guard(blocks: Sequence[Log], stages: Sequence[Stage]) -> list[Finding | None]:
    """For each block what is suspicious about it. The blocks have passed ``stages``, of which an isolation is
    the last; its thresholds are not needed. Of fewer than ``LEAST`` blocks nothing can be said.

    Raises:
        LogError: more than 40 % of the logs are suspicious.
    """
    found: list[Finding | None] = [None] * len(blocks)
    isolate = stages[-1]
    if len(blocks) < LEAST or not isinstance(isolate, Isolate):
        return found
    isolate = isolate.connect(stages[:-1])
    points, directions = isolate.points, directions_of(isolate)
    reduced = Points([h for _, h in directions], points.chain, points.residuals)
    given = np.array([isolate.offsets.get(r, {}).get("1", 0.0) for r in points.residuals])
    for s in suspicious(drive_means(blocks, reduced, given, isolate.correlation_s)):
        name, h = directions[s.fault]
        size = size_of(h, s.size)
        found[s.drive] = Finding(log=blocks[s.drive].name, fault=name, size=size, unit=h.unit, evidence=s.T)
    if (count := sum(f is not None for f in found)) > MOST * len(found):
        named = "\n".join(f"  - {f}" for f in found if f)
        raise LogError(
            f"{count} of {len(found)} logs do not agree with the others, too many to say which are "
            f"fault-free:\n{named}\nlook into them with a detector that is known to be good "
            "(`dynoscope run`), and take out the faulty ones; or take them all with --trust"
        )
    return found


def directions_of(isolate: Isolate) -> list[tuple[str, Hypothesis]]:
    """Every fault at one size to either side, a quarter up its grid."""
    found = []
    evaluated = isolate.points.sizes[-len(isolate.hypotheses) :]
    for (name, h), sizes in zip(isolate.hypotheses.items(), evaluated, strict=True):
        for side in ([s for s in sizes if s > 0], [s for s in reversed(sizes) if s < 0]):
            found += [(name, replace(h, sizes=(x,), inexact=0.0)) for x in side[len(side) // 4 :][:1]]
    return found


def size_of(direction: Hypothesis, times: float) -> float:
    """The size of a fault whose effect is ``times`` that of the direction's own size."""
    grown = np.sqrt(times) if direction.unit == "mm" else times  # flow goes with the hole's area
    return float(direction.sizes[0] * grown)


def drive_means(
    blocks: Sequence[Log], points: Points, offset: Array, correlation_s: float, regions: int = 0
) -> Drives:
    """Mean residuals by region and what each of ``points`` would shift them by; of at most ``ROWS`` steady
    rows a log. ``regions``: how many there are, if more than these logs visit."""
    parts = [_rows(block, points) for block in blocks]
    M = regions or max(int(regime.max(initial=0)) + 1 for _, regime, _ in parts)
    R, F = len(points.residuals), points.count - 1
    mean, count = np.zeros((len(blocks), R, M)), np.zeros((len(blocks), R, M))
    shift, within = np.zeros((len(blocks), F, R, M)), [np.zeros((0, R))]
    for k, (e, regime, weight) in enumerate(parts):
        for r in range(R):
            known = np.isfinite(e[:, :, r]).all(axis=1)
            unit, w = regime[known], weight[known]
            mass = np.bincount(unit, w, minlength=M)
            sums = np.stack([np.bincount(unit, w * x, minlength=M) for x in e[known, :, r].T])
            means = sums / np.maximum(mass, 1e-12)
            mean[k, r], shift[k, :, r] = means[0], means[0] - means[1:]
            count[k, r] = mass / correlation_s
        left = e[:, 0] - np.take_along_axis(mean[k].T, np.broadcast_to(regime[:, None], (len(regime), R)), 0)
        within.append(left)
    noise = 1.4826 * np.nanmedian(np.abs(np.concatenate(within)), axis=0)
    return Drives(mean=mean, count=count, shift=shift, noise=np.maximum(noise, 1e-12), offset=offset)


def _rows(block: Log, points: Points) -> tuple[Array, NDArray[np.int64], Array]:
    """Residuals at the points (rows, points, residuals), regimes, and the time in s that each row stands
    for."""
    values = columns(block)
    rows, each = steady_rows(values)
    wanted = {TIME, GATE, *points.needs} & values.keys()
    e = points.evaluate({c: values[c][rows] for c in wanted}, values[TIME][rows] - values[TIME][0])[0]
    return e.transpose(0, 2, 1), values[REGIME][rows].astype(np.int64), each


def thinned(block: Log) -> Log:
    """At most ``ROWS`` rows of a block, those near steady state if it has a gate."""
    group = block.groups[ANALYSIS]
    frame = group.frame.filter(pl.col(GATE) >= STEADY) if GATE in group.signals else group.frame
    frame = frame.gather_every(max(1, -(-frame.height // ROWS)))
    return replace(block, groups={ANALYSIS: replace(group, frame=frame)})


def steady_rows(values: Mapping[str, Array]) -> tuple[NDArray[np.int64], Array]:
    """At most ``ROWS`` rows near steady state, in a region, and the time in s that each stands for."""
    gate = np.nan_to_num(values.get(GATE, np.ones(len(values[TIME]))))
    rows = np.flatnonzero((gate >= STEADY) & (np.nan_to_num(values[REGIME], nan=-1) >= 0))
    step = max(1, -(-len(rows) // ROWS))
    dt = float(np.median(np.diff(values[TIME]))) if len(values[TIME]) > 1 else 1.0
    return rows[::step], gate[rows[::step]] * dt * step
