"""An alarm's episode: which fault, of what size, until when.

An alarm ends where for ``clear`` s no fault has evidence any more, or the log as it is has been better than
the named fault by that fault's threshold since some time, while no other fault is much better. As in Page's
cumulative sum, the sums since then begin anew whenever the named fault is as good; at the end they become
those of all memories.

The size of a fault may change. With M the sums over such a memory and E the episode's, the named fault has
changed if it explains M and E - M at two sizes better than E at one, by ``change``:

    max L(M) + max L(E - M) - max L(E) > change,    maxima over its sizes.

The episode then is no longer than that memory: a growing fault is judged by what it has grown to. This takes
a memory that would raise the alarm itself.

The compiler's cache does not see changes in another file, see :mod:`stages.likelihood`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.likelihood import SUMS, evidence_of, fade, informed, log_likelihoods, overwrite
from stages.memory import EVIDENCE, NAMED, SINCE, SIZE, Memory, Settings, inlined
from stages.size_grid import Grid

Array = NDArray[np.float64]


@njit(cache=True, error_model="numpy")
def nearest(points: NDArray[np.int64], sizes: Array, size: float) -> int:  # pragma: no cover - compiled
    """The point of a fault at the size of the grid next to ``size``."""
    near = 0 if points[0] > 0 else 1
    for i in range(len(points)):
        if points[i] > 0 and abs(sizes[i] - size) < abs(sizes[near] - size):
            near = i
    return int(points[near])


@inlined
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
def chosen(S: Array, points: NDArray[np.int64]) -> Array:  # pragma: no cover - compiled
    """The sums of some points, and last of the log as it is."""
    sums = np.empty((S.shape[0], SUMS, len(points) + 1))
    for r in range(S.shape[0]):
        for k in range(SUMS):
            for i in range(len(points)):
                sums[r, k, i] = S[r, k, points[i]]
            sums[r, k, -1] = S[r, k, 0]
    return sums


@inlined
def shorten(memory: Memory, settings: Settings, grid: Grid) -> None:  # pragma: no cover - compiled
    """Let the episode be no longer than the memory over which the named fault's size is not that of
    before."""
    S, clocks, T = memory.S, memory.clocks, len(memory.S) - 2
    f = int(clocks[NAMED])
    at = grid.points[f, : grid.counts[f]]
    episode = chosen(S[T], at)
    whole = np.max(log_likelihoods(episode, settings.sd, settings.sd)[:-1])
    gain, since = settings.change, 0
    for i in range(2, T):  # those that begin with the episode
        if settings.memories[i] < clocks[SINCE]:
            sums = chosen(S[i], at)
            L = log_likelihoods(sums, settings.sd, settings.sd)
            recent = np.max(L[:-1])
            if recent - L[-1] < settings.threshold[i, f]:  # no fault, or too little to say
                continue
            fade(sums, -1.0, episode, settings.sd)  # what was before
            before = np.max(log_likelihoods(sums, settings.sd, settings.sd)[:-1])
            if recent + before - whole > gain:
                gain, since = recent + before - whole, i
    if since > 0:
        for i in range(since + 1, T + 1):
            overwrite(S[i], S[since])
        memory.kept[:] = 0.0
        clocks[SINCE] = settings.memories[since]


@inlined
def judge(memory: Memory, settings: Settings, grid: Grid) -> None:  # pragma: no cover - compiled
    """Evidence of the episode and the probabilities, in alarm."""
    clocks, T, F = memory.clocks, len(memory.S) - 2, grid.points.shape[0]
    evidence, p, nothing = memory.evidence, memory.p, memory.fresh  # which has just been settled
    sums = informed(memory.S[T], memory.before, nothing, settings.wander, grid.prior, settings.sd)
    L = log_likelihoods(sums, settings.sd, settings.unknown_sd)
    for i in range(len(L)):
        L[i] += memory.kept[i]
    evidence_of(L, grid, evidence, memory.size, memory.size_sd)
    evidence[F] -= settings.penalty
    memory.statistic[0], top, named, total = -np.inf, np.max(evidence), 0, 0.0
    for f in range(F):
        memory.largest[T - 1, f] = max(memory.largest[T - 1, f], evidence[f])
        memory.statistic[0] = max(memory.statistic[0], evidence[f] - settings.threshold[T - 1, f])
        if evidence[f] > evidence[named]:
            named = f
    for f in range(F + 1):
        p[f] = np.exp(settings.temper * (evidence[f] - top))
        total += p[f]
    for f in range(F + 1):
        p[f] /= total
    clocks[NAMED], clocks[SIZE], clocks[EVIDENCE] = named, memory.size[named], evidence[named]
