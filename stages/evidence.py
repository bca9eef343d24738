"""Evidence for faults over time: sums over several memories, steps at rest, the alarm and its episode.

The log-likelihood (:mod:`stages.likelihood`) of every point, a hypothesis at a size, is kept over several
memories. Once the log before a memory tells the offsets, they are known but for what they wander within a
log, and thresholds are lower: what differs from run to run no longer matters. An alarm keeps what was before
it.

Besides, while the operating point stays, a change within the log can be seen that is smaller still: for a
step ``age`` s ago the sums are those of the log as it is before it, and of the point after it, with any
offset, the same before and after.

An alarm begins where some evidence has been above its threshold for ``confirm`` s; the episode's sums
(:mod:`stages.episode`) and those of the long memories then begin anew.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.episode import ends, judge, shorten
from stages.likelihood import (
    SUMS,
    evidence_of,
    fade,
    informed,
    log_likelihoods,
    offsets_known,
    overwrite,
)
from stages.memory import (
    ACTIVE,
    ALARM,
    DECIDED,
    HELD,
    RESTED,
    SINCE,
    Memory,
    Rows,
    Settings,
    inlined,
    remember,
    settle,
)
from stages.size_grid import Grid

Array = NDArray[np.float64]
QUANTILE = 1.645  # 95 % of a normal deviate lie below


@inlined
def step_likelihoods(
    memory: Memory, settings: Settings, grid: Grid, age: float
) -> Array:  # pragma: no cover - compiled
    """L of every point for a log that was healthy until ``age`` s ago and has since been what the point
    supposes, with any offsets, the same before and after; empty where the rest is not long enough.

    Only what came after differs from the log as it is, so L is that of sums after + before (as it is).
    """
    now, place = memory.clocks[RESTED], -1
    for i in range(len(memory.times)):
        if memory.times[i] <= now - age and (place < 0 or memory.times[i] > memory.times[place]):
            place = i
    if place < 0:
        return np.empty(0)
    rest, before = memory.S[-1], memory.earlier[place]
    kept, sums = np.exp(-(now - memory.times[place]) / settings.memories[-1]), np.empty(rest.shape)
    R, P = rest.shape[0], rest.shape[2]
    for r in range(R):
        for k in range(SUMS):
            for p in range(P):
                sums[r, k, p] = rest[r, k, p] - kept * (before[r, k, p] - before[r, k, 0])
            for p in range(P - 1):
                if grid.prior[p] > -np.inf:  # what healthy logs show was there before
                    sums[r, k, p] = rest[r, k, p]
    return log_likelihoods(sums, settings.unknown_sd, settings.unknown_sd)


@inlined
def note_rest(memory: Memory) -> None:  # pragma: no cover - compiled
    """Keep the rest's sums once a second, in a ring that is longer than the greatest age of a step."""
    now = memory.clocks[RESTED]
    slot = int(now) % len(memory.times)
    if now > 0 and np.floor(now) != np.floor(memory.times[slot]):
        overwrite(memory.earlier[slot], memory.S[-1])
        memory.times[slot] = now


@njit(cache=True, error_model="numpy")
def note_detectable(
    L: Array, threshold: Array, grid: Grid, detectable: Array
) -> None:  # pragma: no cover - compiled
    """Lower ``detectable`` to the sizes that would have been seen at 95 % in what ``L`` remembers.

    By symmetry a fault would gain over being healthy what being healthy gains over the fault, ``G``. A gain
    of mean m has standard deviation ``sqrt(2 m)``, and goes with the square of the size, where size 0 is
    being healthy.
    """
    for f in range(len(detectable)):
        from_zero = False
        for k in range(grid.counts[f]):
            from_zero = from_zero or grid.points[f, k] == 0
        needed = 0.5 * (QUANTILE + np.sqrt(QUANTILE**2 + 2.0 * threshold[f])) ** 2
        for k in range(grid.counts[f]):
            gain = L[0] - L[grid.points[f, k]]
            if gain >= needed:
                size = abs(grid.sizes[f, k]) * (np.sqrt(needed / gain) if from_zero else 1.0)
                detectable[f] = min(detectable[f], size)


@inlined
def weigh(memory: Memory, settings: Settings, grid: Grid) -> int:  # pragma: no cover - compiled
    """Evidence over every memory and for steps, without an alarm; which of them exceeds its threshold
    most."""
    S, T, F, strongest = memory.S, len(memory.S) - 2, grid.points.shape[0], 0
    memory.statistic[0], memory.evidence[:] = -np.inf, -np.inf
    evidence, size, size_sd = np.empty(F + 1), np.empty(F), np.empty(F)
    for i in range(T + len(settings.ages)):
        stepped, row = i >= T, min(i, T)
        if stepped:
            L = step_likelihoods(memory, settings, grid, settings.ages[i - T])
            if not len(L):
                continue
        else:
            sums = S[i]
            if offsets_known(sums, S[T - 1], settings.sd, settings.wander):
                sums = informed(sums, S[T - 1], sums, settings.wander, grid.prior, settings.sd)
                row = T + 1
            L = log_likelihoods(sums, settings.sd, settings.unknown_sd)
            note_detectable(L, settings.threshold[row], grid, memory.detectable)
        evidence_of(L, grid, evidence, size, size_sd)
        for f in range(F):
            memory.largest[row, f] = max(memory.largest[row, f], evidence[f])
            excess = evidence[f] - settings.threshold[row, f]
            if excess > memory.statistic[0]:
                memory.statistic[0], strongest = excess, i
                for p in range(len(L)):
                    memory.kept[p] = L[p] - L[0] if stepped else 0.0
            if evidence[f] > memory.evidence[f]:
                memory.evidence[f], memory.size[f], memory.size_sd[f] = evidence[f], size[f], size_sd[f]
        memory.evidence[F] = max(memory.evidence[F], evidence[F] - settings.penalty)
    return strongest


@inlined
def decide(
    memory: Memory, settings: Settings, grid: Grid, elapsed: float
) -> None:  # pragma: no cover - compiled
    """The alarm's begin and end; ``elapsed`` s since the last decision."""
    S, clocks, T, strongest = memory.S, memory.clocks, len(memory.S) - 2, 0
    alarm = clocks[ALARM] == 1
    if alarm:
        holds = ends(memory, settings, grid)
    else:
        strongest = weigh(memory, settings, grid)
        holds = memory.statistic[0] > 0
    # a long time without samples confirms nothing
    clocks[HELD] = clocks[HELD] + min(elapsed, 2.0 * settings.decide) if holds else 0.0
    clocks[SINCE] += elapsed
    if clocks[HELD] < (settings.clear if alarm else settings.confirm):
        return
    if alarm:
        for i in range(T):
            overwrite(S[i], memory.ended)
        fade(S[T - 1], 1.0, memory.before, settings.sd)  # offsets are still known
    else:
        overwrite(memory.before, S[min(strongest, T - 1)])
        fade(memory.before, -1.0, S[T - 1], settings.sd)
        S[2 : T + 1] = 0.0
        for p in range(len(grid.prior)):
            if grid.prior[p] > -np.inf:
                memory.kept[p] = 0.0
        memory.kept[-1] = np.max(memory.kept[:-1])
    memory.ended[:] = 0.0
    clocks[:RESTED] = 0.0
    clocks[ALARM] = 0.0 if alarm else 1.0


@njit(cache=True, error_model="numpy")
def follow(
    rows: Rows, grid: Grid, settings: Settings, memory: Memory
) -> tuple[Array, NDArray[np.int8], Array, Array, Array, Array, Array]:  # pragma: no cover - compiled
    """The recursion over the rows; changes ``memory`` in place."""
    N, F = len(rows.dt), grid.points.shape[0]
    statistic, detection = np.empty(N), np.zeros(N, dtype=np.int8)
    out_evidence, out_p = np.empty((N, F + 1)), np.empty((N, F + 1))
    out_size, out_sd, out_least = np.empty((N, F)), np.empty((N, F)), np.empty((N, F))
    clocks = memory.clocks
    for k in range(N):
        remember(memory, settings, grid, rows, k)
        clocks[DECIDED] += rows.dt[k]
        if clocks[ACTIVE] == 1 and clocks[DECIDED] >= settings.decide:  # else nothing new is known
            elapsed = clocks[DECIDED]
            clocks[ACTIVE], clocks[DECIDED] = 0.0, 0.0
            settle(memory, settings)
            decide(memory, settings, grid, elapsed)
            if len(settings.ages):
                note_rest(memory)
            if clocks[ALARM] == 1:
                shorten(memory, settings, grid)
                judge(memory, settings, grid)
            else:
                memory.p[:] = 0.0
        statistic[k], detection[k] = memory.statistic[0], np.int8(clocks[ALARM])
        for f in range(F + 1):
            out_evidence[k, f], out_p[k, f] = memory.evidence[f], memory.p[f]
        for f in range(F):
            out_size[k, f], out_sd[k, f] = memory.size[f], memory.size_sd[f]
            out_least[k, f] = memory.detectable[f]
    return statistic, detection, out_evidence, out_p, out_size, out_sd, out_least
