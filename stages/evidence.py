"""Evidence for faults over time: sums over several memories, steps at rest, the alarm and its episode.

The log-likelihood (:mod:`stages.likelihood`) of every point, a hypothesis at a size, is kept over several
memories. Once the log before a memory tells the offsets, they are known but for what they wander within a
log, and thresholds are lower: what differs from run to run no longer matters. An alarm keeps what was before
it.

Besides, while the operating point stays, a change within the log can be seen that is smaller still: for a
step ``age`` s ago the sums are those of the log as it is before it, and of the point after it, with any
offset, the same before and after.

An alarm begins where some evidence has been above its threshold for ``confirm`` s; the episode's sums and
those of the long memories then begin anew. It ends where for ``clear`` s no fault has evidence any more, or
the log as it is has been better than the named fault by that fault's threshold since some time, while no
other fault is much better. As in Page's cumulative sum, the sums since then begin anew whenever the named
fault is as good; at the end they become those of all memories.

The size of a fault may change. With M the sums over such a memory and E the episode's, the named fault has
changed if it explains M and E - M at two sizes better than E at one, by ``change``:

    max L(M) + max L(E - M) - max L(E) > change,    maxima over its sizes.

The episode then is no longer than that memory: a growing fault is judged by what it has grown to. This takes
a memory that would raise the alarm itself.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.likelihood import SUMS, informed, log_likelihoods, offsets_known, peak
from stages.memory import (
    ACTIVE,
    ALARM,
    DECIDED,
    EVIDENCE,
    HELD,
    NAMED,
    RESTED,
    SINCE,
    SIZE,
    Memory,
    Rows,
    Settings,
    remember,
    settle,
)
from stages.size_grid import Grid

Array = NDArray[np.float64]
QUANTILE = 1.645  # 95 % of a normal deviate lie below


@njit(cache=True, error_model="numpy")
def evidence_of(L: Array, grid: Grid) -> tuple[Array, Array, Array]:  # pragma: no cover - compiled
    """Evidence of every fault, and last of ``unknown``; sizes and their standard deviations."""
    F, H = grid.points.shape[0], len(L) - 1
    healthy, top = 0.0, -np.inf
    for p in range(H):
        top = max(top, L[p] + grid.prior[p])
    for p in range(H):
        if grid.prior[p] > -np.inf:
            healthy += np.exp(L[p] + grid.prior[p] - top)
    healthy = top + np.log(healthy)
    evidence, size, size_sd = np.empty(F + 1), np.empty(F), np.empty(F)
    for f in range(F):
        x = grid.sizes[f, : grid.counts[f]]
        size[f], height, size_sd[f] = peak(x, L[grid.points[f, : grid.counts[f]]])
        width = min(1.0, np.sqrt(2.0 * np.pi) * size_sd[f] / (x[-1] - x[0]))
        evidence[f] = height + np.log(width) - healthy
    evidence[F] = L[H] - healthy
    return evidence, size, size_sd


@njit(cache=True, error_model="numpy")
def nearest(points: NDArray[np.int64], sizes: Array, size: float) -> int:  # pragma: no cover - compiled
    """The point of a fault at the size of the grid next to ``size``."""
    near = 0 if points[0] > 0 else 1
    for i in range(len(points)):
        if points[i] > 0 and abs(sizes[i] - size) < abs(sizes[near] - size):
            near = i
    return int(points[near])


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def note_rest(memory: Memory) -> None:  # pragma: no cover - compiled
    """Keep the rest's sums once a second, in a ring that is longer than the greatest age of a step."""
    now = memory.clocks[RESTED]
    slot = int(now) % len(memory.times)
    if now > 0 and np.floor(now) != np.floor(memory.times[slot]):
        memory.earlier[slot] = memory.S[-1]
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


@njit(cache=True, error_model="numpy")
def ends(memory: Memory, settings: Settings, grid: Grid) -> bool:  # pragma: no cover - compiled
    """Whether the fault is over; begins ``ended`` anew where it is not."""
    clocks, f = memory.clocks, int(memory.clocks[NAMED])
    L = log_likelihoods(memory.ended, settings.sd, settings.unknown_sd)
    named = L[nearest(grid.points[f, : grid.counts[f]], grid.sizes[f], clocks[SIZE])]
    if named >= L[0]:
        memory.ended[:] = 0.0
    better = np.max(L[:-1]) - L[0]
    over = L[0] - named > settings.threshold[1, f] and better < 0.5 * settings.threshold[1, f]
    known = clocks[SINCE] > settings.memories[1]
    return bool(known and (over or clocks[EVIDENCE] <= 0.0))


@njit(cache=True, error_model="numpy")
def shorten(memory: Memory, settings: Settings, grid: Grid) -> None:  # pragma: no cover - compiled
    """Let the episode be no longer than the memory over which the named fault's size is not that of
    before."""
    S, clocks, T = memory.S, memory.clocks, len(memory.S) - 2
    f = int(clocks[NAMED])
    at = np.append(grid.points[f, : grid.counts[f]], 0)  # the log as it is last
    episode = S[T][:, :, at]
    whole = np.max(log_likelihoods(episode, settings.sd, settings.sd)[:-1])
    gain, since = settings.change, 0
    for i in range(2, T):  # those that begin with the episode
        if settings.memories[i] < clocks[SINCE]:
            sums = S[i][:, :, at]
            L = log_likelihoods(sums, settings.sd, settings.sd)
            recent = np.max(L[:-1])
            if recent - L[-1] < settings.threshold[i, f]:  # no fault, or too little to say
                continue
            before = np.max(log_likelihoods(episode - sums, settings.sd, settings.sd)[:-1])
            if recent + before - whole > gain:
                gain, since = recent + before - whole, i
    if since > 0:
        S[since : T + 1] = S[since]
        memory.kept[:] = 0.0
        clocks[SINCE] = settings.memories[since]


@njit(cache=True, error_model="numpy")
def weigh(memory: Memory, settings: Settings, grid: Grid) -> int:  # pragma: no cover - compiled
    """Evidence over every memory and for steps, without an alarm; which of them exceeds its threshold
    most."""
    S, T, F, strongest = memory.S, len(memory.S) - 2, grid.points.shape[0], 0
    memory.statistic[0], memory.evidence[:] = -np.inf, -np.inf
    for i in range(T + len(settings.ages)):
        stepped, row = i >= T, min(i, T)
        if stepped:
            L = step_likelihoods(memory, settings, grid, settings.ages[i - T])
            if not len(L):
                continue
        else:
            sums = S[i]
            if offsets_known(sums, S[T - 1], settings.sd, settings.wander):
                sums, row = informed(sums, S[T - 1], settings.wander, grid.prior), T + 1
            L = log_likelihoods(sums, settings.sd, settings.unknown_sd)
            note_detectable(L, settings.threshold[row], grid, memory.detectable)
        evidence, size, size_sd = evidence_of(L, grid)
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


@njit(cache=True, error_model="numpy")
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
        S[:T] = memory.ended
        S[T - 1] += memory.before  # offsets are still known
    else:
        memory.before[:] = S[T - 1] - S[min(strongest, T - 1)]
        S[2 : T + 1] = 0.0
        for p in range(len(grid.prior)):
            if grid.prior[p] > -np.inf:
                memory.kept[p] = 0.0
        memory.kept[-1] = np.max(memory.kept[:-1])
    memory.ended[:] = 0.0
    clocks[:RESTED] = 0.0
    clocks[ALARM] = 0.0 if alarm else 1.0


@njit(cache=True, error_model="numpy")
def judge(memory: Memory, settings: Settings, grid: Grid) -> None:  # pragma: no cover - compiled
    """Evidence of the episode and the probabilities, in alarm."""
    clocks, T, F = memory.clocks, len(memory.S) - 2, grid.points.shape[0]
    sums = informed(memory.S[T], memory.S[T] + memory.before, settings.wander, grid.prior)
    L = log_likelihoods(sums, settings.sd, settings.unknown_sd)
    for i in range(len(L)):
        L[i] += memory.kept[i]
    evidence, memory.size[:], memory.size_sd[:] = evidence_of(L, grid)
    evidence[F] -= settings.penalty
    memory.evidence[:] = evidence
    memory.largest[T - 1] = np.maximum(memory.largest[T - 1], evidence[:F])
    memory.statistic[0] = np.max(evidence[:F] - settings.threshold[T - 1])
    odds = np.exp(settings.temper * (evidence - np.max(evidence)))
    memory.p[:] = odds / odds.sum()
    clocks[NAMED] = np.argmax(evidence[:F])
    clocks[SIZE], clocks[EVIDENCE] = memory.size[int(clocks[NAMED])], np.max(evidence[:F])


@njit(cache=True, error_model="numpy")
def follow(
    rows: Rows, grid: Grid, settings: Settings, memory: Memory
) -> tuple[Array, NDArray[np.int8], Array, Array, Array, Array, Array]:  # pragma: no cover - compiled
    """The recursion over the rows; changes ``memory`` in place."""
    N, F = len(rows.dt), grid.points.shape[0]
    statistic, detection = np.empty(N), np.zeros(N, dtype=np.int8)
    out_evidence, out_p = np.empty((N, F + 1)), np.empty((N, F + 1))
    out_size, out_sd, out_least = np.empty((N, F)), np.empty((N, F)), np.empty((N, F))
    clocks, row = memory.clocks, 0
    for k in range(N):
        remember(memory, settings, grid, rows, k, row)
        row += rows.active[k]
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
        out_evidence[k], out_p[k] = memory.evidence, memory.p
        out_size[k], out_sd[k], out_least[k] = memory.size, memory.size_sd, memory.detectable
    return statistic, detection, out_evidence, out_p, out_size, out_sd, out_least
