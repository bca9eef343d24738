"""What the isolation remembers: sums of the likelihood over several memories, of a rest and of an episode.

The sums (:mod:`stages.likelihood`) of every point, a hypothesis at a size, fade with each memory's time;
those of a rest begin anew when the operating point leaves it.

The compiler's cache does not see changes in another file, see :mod:`stages.likelihood`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.likelihood import SUMS, add_sample, fade
from stages.size_grid import Grid

Array = NDArray[np.float64]
ALARM, HELD, NAMED, SIZE, EVIDENCE, SINCE, DECIDED, FADED, RESTED, SEEN, ACTIVE = range(11)  # clocks
CLOCKS = 11

inlined = njit(inline="always")  # into the one function that calls it: compiled once, not with every caller


class Rows(NamedTuple):
    """What is known of a block's rows, ``active`` is each one's number among those looked at, else -1. Only
    of these: ``share`` (active rows,) of an independent sample, ``weight`` (active rows, residuals) that each
    counts, ``e sigma ln_sigma doubt`` (active rows, residuals, points), ``shapes`` (active rows, residuals,
    2). ``place`` (rows, any): the operating point, a rest ends 1 away from where it began."""

    dt: Array
    active: NDArray[np.int64]
    place: Array
    share: Array
    weight: Array
    e: Array
    sigma: Array
    ln_sigma: Array
    doubt: Array
    shapes: Array


class Settings(NamedTuple):
    """``memories``: those of the alarm, the episode's, and that of a rest; ``ages`` of a step in s;
    ``sd unknown_sd`` of the offsets (residuals, 2), and how far they
    ``wander`` within a log (residuals,)."""

    memories: Array
    ages: Array
    threshold: Array
    sd: Array
    unknown_sd: Array
    clip: float
    confirm: float
    clear: float
    decide: float
    temper: float
    penalty: float
    change: float
    wander: Array


class Memory(NamedTuple):
    """What the recursion remembers, changed in place: sums by memory (the episode's and the rest's last),
    residual and point; those since the last decision; those of the rest at earlier seconds and their times;
    where it began; log-likelihood ratios that an episode began with; sums of what was before it; those since
    the named fault was last as good as none; clocks; the largest evidence so far, and the smallest size that
    would have been seen; the last decision."""

    S: Array
    fresh: Array
    earlier: Array
    times: Array
    place: Array
    kept: Array
    before: Array
    ended: Array
    clocks: Array
    largest: Array
    detectable: Array
    statistic: Array
    evidence: Array
    p: Array
    size: Array
    size_sd: Array

    @classmethod
    def empty(
        cls, *, memories: int, residuals: int, points: int, faults: int, places: int, seconds: int
    ) -> Memory:
        """That of a log's start; ``places``: columns of the operating point, ``seconds`` of a rest that are
        kept."""
        sums = (residuals, SUMS, points)
        return cls(
            S=np.zeros((memories, *sums)),
            fresh=np.zeros(sums),
            earlier=np.zeros((seconds, *sums)),
            times=np.full(seconds, np.inf),
            place=np.full(places, np.nan),
            kept=np.zeros(points),
            before=np.zeros(sums),
            ended=np.zeros(sums),
            clocks=np.zeros(CLOCKS),
            largest=np.full((memories, faults), -np.inf),
            detectable=np.full(faults, np.inf),
            statistic=np.full(1, -np.inf),
            evidence=np.zeros(faults + 1),
            p=np.zeros(faults + 1),
            size=np.zeros(faults),
            size_sd=np.full(faults, np.nan),
        )


@njit(cache=True, error_model="numpy")
def settle(memory: Memory, settings: Settings) -> None:  # pragma: no cover - compiled
    """Let all sums fade by the time that has passed, and add the fresh ones. In an alarm nobody asks for the
    shortest memory; at its end all memories begin anew."""
    passed = memory.clocks[FADED]
    alarm = memory.clocks[ALARM] == 1
    for i in range(1 if alarm else 0, len(memory.S) if len(settings.ages) else len(memory.S) - 1):
        fade(memory.S[i], np.exp(-passed / settings.memories[i]), memory.fresh, settings.sd)
    if alarm:
        fade(memory.ended, 1.0, memory.fresh, settings.sd)
    memory.fresh[:] = 0.0
    memory.clocks[FADED] = 0.0


@inlined
def remember(
    memory: Memory, settings: Settings, grid: Grid, rows: Rows, k: int
) -> None:  # pragma: no cover - compiled
    """Add row ``k`` to the fresh sums."""
    dt, row, clocks = rows.dt[k], rows.active[k], memory.clocks
    clocks[FADED] += dt
    clocks[RESTED] += dt
    for j in range(len(memory.place)):
        if not abs(rows.place[k, j] - memory.place[j]) <= 1.0:
            settle(memory, settings)
            for i in range(len(memory.place)):
                memory.place[i] = rows.place[k, i]
            memory.S[-1] = 0.0
            clocks[RESTED] = 0.0
            memory.times[:] = np.inf
            break
    if row < 0:
        return
    share = rows.share[row]
    row_of = (rows.e[row], rows.sigma[row], rows.ln_sigma[row], rows.doubt[row])
    weights, seen = rows.weight[row], clocks[SEEN]
    add_sample(memory.fresh, row_of, grid, rows.shapes[row], weights, memory.S[1], seen, settings.clip)
    clocks[SEEN] += share
    clocks[ACTIVE] = 1.0
