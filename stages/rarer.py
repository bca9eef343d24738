"""Rarer faults: compared with the usual ones in an alarm's window only, as each is likely to be mistaken.

An offset of a sensor looks much like a gain where the operating point moves little. It is undone like any
other hypothesis (:mod:`stages.hypotheses`), and its height is the Laplace approximation of its marginal
log-likelihood, less a ``penalty``, as it is the rarer one,

    L = L(peak) + ln min(1, sqrt(2 pi) d / range of sizes) - penalty,

d the standard deviation of the size, where the penalty is at least by how much a usual fault is likelier
whose size changes once. Evidence of an episode is that of the likeliest fault f* of those that were followed
from its begin, or of `unknown`, and what L is above theirs in the window, whichever says more:

    evidence = max(evidence_f* + L - L_f*, evidence_unknown + L - L_unknown),
    evidence_unknown <= evidence_f* + L_unknown - L_f*,

the latter as what changed in the course of an episode does not make the window's fault unknown; all on
samples that some hypothesis brings to where the relations were trained. Named ``<fault>.<signal>``, as
several sensors can have it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stages.alarm_window import Window
from stages.hypotheses import Hypothesis, Points
from stages.isolate import Isolate
from stages.likelihood import peak
from stages.relations import familiarity
from stages.results import OF
from stages.size_grid import Grid, refined_grid

Also = Mapping[str, Mapping[str, Hypothesis]]  # by fault and signal


@dataclass(frozen=True)
class Alone:
    """A fault alone: how evident it is beside the likeliest usual one, and beside `unknown`; its size and the
    size's standard deviation."""

    height: float
    over_unknown: float
    size: float
    sd: float


ONE = "one"  # the likeliest usual fault
UNSEEN = Alone(-np.inf, -np.inf, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class Rarer:
    """The hypotheses ``names``, all their sizes to compute, and the refined grid of these."""

    names: tuple[str, ...]
    points: Points
    grid: Grid

    @classmethod
    def of(cls, also: Also, isolate: Isolate) -> Rarer:
        """Those of ``also``, judged by the residuals of ``isolate``."""
        named = {fault + OF + signal: h for fault, some in also.items() for signal, h in some.items()}
        points = Points([*named.values()], isolate.points.chain, isolate.points.residuals)
        grid = refined_grid(points.hypotheses, points.sizes, 0, isolate.between)
        return cls(tuple(named), points, grid)

    def compared(self, usual: Window, isolate: Isolate, penalty: float) -> dict[str, Alone]:
        """How each stands beside the hypotheses of the window, which are those of ``isolate``."""
        window = usual.supposing(self.points, self.grid)
        known = familiarity(np.minimum(usual.computed[3], window.computed[3]), isolate.known_to)
        usual, window = usual.trusted(known), window.trusted(known)
        unknown = usual.unknown(isolate.wide_sd) - isolate.unknown_penalty
        best, L, grid = usual.most, window.on_grid, self.grid
        found: dict[str, tuple[float, float, float]] = {}
        for k, name in enumerate(self.names):
            x = grid.sizes[k, : grid.counts[k]]
            size, height, sd = peak(x, L[grid.points[k, : grid.counts[k]]])
            height += float(np.log(min(1.0, np.sqrt(2 * np.pi) * sd / (x[-1] - x[0]))))
            found[name] = height, size, sd if np.isfinite(sd) else np.nan
        if max(height for height, *_ in found.values()) > best + penalty:
            penalty = max(penalty, usual.alone - best)  # a fault whose size changes is none of these
        return {ONE: Alone(0.0, best - unknown, np.nan, np.nan)} | {
            name: Alone(height - penalty - best, height - penalty - unknown, size, sd)
            for name, (height, size, sd) in found.items()
        }
