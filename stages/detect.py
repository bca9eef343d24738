"""Detect: is a residual's mean off zero, by more than noise and run-to-run scatter explain?

For every residual e with spread sigma and every memory T the stage keeps, with forgetting ``exp(-dt / T)``,

    S0 = sum w / sigma^2,   S1 = sum w e / sigma^2,   w = min(dt, tau_c) / tau_c,

so that ``m = S1 / S0`` is the remembered mean. With V, the same as S0 but forgotten twice as fast,
``V / S0^2`` is its variance for noise correlated over ``tau_c``. Between healthy runs the mean scatters by
``offset``; what the relations are in doubt of (``model_sd``) does not average out either, so its remembered
mean square ``S2 / S0`` counts whole:

    z = m / sqrt(V / S0^2 + S2 / S0 + offset^2).

The alarm statistic is the largest ``|z|`` over residuals and memories, each in units of its threshold: short
memories find large faults at once, long ones small faults. It must exceed 1 for ``confirm_s``; the alarm ends
when it has stayed below 0.7 for ``clear_s``. Every quantity at a row is made of data up to that row.

While there is no alarm, ``mean.<r>`` and ``mean_sd.<r>`` are those of the memory with the largest ``|z|``;
from the alarm on they are those of the episode, which starts from the shortest memory and forgets with the
longest, so that what was before the fault does not blur it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import TIME, Log
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA, residual_names
from stages.results import DETECTION, STATISTIC
from stages.stage import ANALYSIS, Arrays, Stage, add_columns, columns

Array = NDArray[np.float64]
MEAN, MEAN_SD = "mean.", "mean_sd."


@dataclass(frozen=True, eq=False)
class DetectState:
    """Sums S0, S1, S2, V by memory (the episode last) and residual, (4, T + 1, R); the alarm's clocks."""

    time: float
    S: Array
    clocks: Array  # [in alarm (0 or 1), time above the threshold, time below the release level]
    largest: Array  # |z| so far, by memory and residual


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Memories in s, the noise's correlation time, and how an alarm is confirmed and cleared.

    ``offset``: known run-to-run standard deviation of a residual's mean; what the calibration logs show is
    taken where it is larger. The threshold of a residual over a memory is ``margin`` times the largest
    ``|z|`` in the calibration logs, at least ``min_threshold``.

    Raises:
        RecipeError: memories are not increasing and positive, or nothing has been learned yet.
    """

    version: ClassVar[str] = "1"
    learns_from: ClassVar[Literal["calibration"]] = "calibration"
    memories_s: tuple[float, ...] = (10.0, 30.0, 100.0, 300.0)
    correlation_s: float = 2.0
    offset: Mapping[str, float] = field(default_factory=dict)
    margin: float = 1.25
    min_threshold: float = 5.0
    confirm_s: float = 2.0
    clear_s: float = 10.0
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        m = self.memories_s
        if not m or m[0] <= 0 or any(b <= a for a, b in pairwise(m)):
            raise RecipeError(f"detect: memories_s must be positive and increasing, got {list(m)}")

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        names = residual_names(blocks[0])
        given = np.array([self.offset.get(r, 0.0) for r in names])
        seen = np.array([between_runs(blocks, r, self.memories_s[-1], self.correlation_s) for r in names])
        offset = np.maximum(given, seen)
        silent = replace(self, learned={"offset": offset, "threshold": np.full(self._shape(names), np.inf)})
        largest = np.max([silent.step(silent.start(), b)[0].largest for b in blocks], axis=0)
        threshold = np.maximum(self.margin * largest, self.min_threshold)
        return replace(self, learned={"offset": offset, "threshold": threshold})

    def _shape(self, names: Sequence[str]) -> tuple[int, int]:
        return len(self.memories_s), len(names)

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self.fit(blocks)

    @property
    def needs(self) -> set[str]:
        return set()

    @property
    def adds(self) -> set[str]:
        return {STATISTIC, DETECTION}

    def start(self) -> DetectState:
        T, R = self._learned("threshold").shape
        return DetectState(np.nan, np.zeros((4, T + 1, R)), np.zeros(3), np.zeros((T, R)))

    def step(self, state: DetectState, block: Log, /) -> tuple[DetectState, Log]:
        names = residual_names(block)
        time = block.groups[ANALYSIS].time
        e, sigma, doubt = (_stack(block, prefix, names) for prefix in (RESIDUAL, SIGMA, MODEL_SD))
        dt = np.diff(time, prepend=state.time)
        dt = np.where(np.isfinite(dt), dt, self.correlation_s)
        S, clocks, largest = state.S.copy(), state.clocks.copy(), state.largest.copy()
        statistic, detection, mean, sd = _run(
            dt, e, sigma, doubt, np.array([*self.memories_s, self.memories_s[-1]]), self._learned("offset"),
            self._learned("threshold"), np.array([self.correlation_s, self.confirm_s, self.clear_s]),
            S, clocks, largest,
        )  # fmt: skip
        added: dict[str, NDArray[Any]] = {STATISTIC: statistic, DETECTION: detection}
        for i, r in enumerate(names):
            added |= {MEAN + r: mean[:, i], MEAN_SD + r: sd[:, i]}
        last = float(time[-1]) if time.size else state.time
        return DetectState(last, S, clocks, largest), add_columns(block, added)

    def _learned(self, name: str) -> NDArray[Any]:
        if name not in self.learned:
            raise RecipeError("detect: nothing learned yet; fit it first")
        return self.learned[name]


def between_runs(blocks: Sequence[Log], residual: str, segment_s: float, correlation_s: float) -> float:
    """Standard deviation of a residual's mean between healthy stretches of ``segment_s``, noise taken off."""
    means, noise = [], []
    for block in blocks:
        values = columns(block, [TIME, RESIDUAL + residual, SIGMA + residual])
        time, e, sigma = values.values()
        dt = np.minimum(np.diff(time, prepend=time[0] if time.size else 0.0), correlation_s) / correlation_s
        weight = np.where(np.isfinite(e), dt / sigma**2, 0.0)
        part = ((time - time[0]) // segment_s).astype(int) if time.size else np.empty(0, dtype=int)
        S0, S1 = np.bincount(part, weight), np.bincount(part, weight * np.nan_to_num(e))
        enough = 0.25 * S0.max(initial=0.0) < S0
        means += list(S1[enough] / S0[enough])
        noise += list(1.0 / S0[enough])
    return float(np.sqrt(max(np.mean(np.square(means)) - np.mean(noise), 0.0))) if means else 0.0


def _stack(block: Log, prefix: str, names: Sequence[str]) -> Array:
    return np.column_stack(list(columns(block, [prefix + r for r in names]).values()))


@njit(cache=True)
def _spread(S: Array, offset: float) -> float:  # pragma: no cover - compiled
    """Standard deviation of a healthy remembered mean."""
    return float(np.sqrt(S[3] / S[0] ** 2 + S[2] / S[0] + offset**2))


@njit(cache=True)
def _run(
    dt: Array, e: Array, sigma: Array, doubt: Array, memories: Array, offset: Array, threshold: Array,
    times: Array, S: Array, clocks: Array, largest: Array,
) -> tuple[Array, NDArray[np.int8], Array, Array]:  # fmt: skip  # pragma: no cover - compiled
    """The recursion over the rows; changes ``S``, ``clocks`` and ``largest`` in place. The last memory is the
    episode."""
    N, R = e.shape
    statistic, detection = np.zeros(N), np.zeros(N, dtype=np.int8)
    mean, sd = np.full((N, R), np.nan), np.full((N, R), np.nan)
    correlation, confirm, clear = times
    episode = len(memories) - 1
    for k in range(N):
        share = min(dt[k], correlation) / correlation
        best = 0
        for i in range(len(memories)):
            keep = np.exp(-dt[k] / memories[i])
            S[:3, i] *= keep
            S[3, i] *= keep**2
            for r in range(R):
                if not np.isnan(e[k, r]):
                    weight = share / sigma[k, r] ** 2
                    S[0, i, r] += weight
                    S[1, i, r] += weight * e[k, r]
                    S[2, i, r] += weight * doubt[k, r] ** 2
                    S[3, i, r] += weight
                if i != episode and S[0, i, r] > 0:
                    z = abs(S[1, i, r]) / S[0, i, r] / _spread(S[:, i, r], offset[r])
                    largest[i, r] = max(largest[i, r], z)
                    if z / threshold[i, r] > statistic[k]:
                        statistic[k], best = z / threshold[i, r], i
        if clocks[0] == 0:
            clocks[1] = clocks[1] + dt[k] if statistic[k] > 1.0 else 0.0
            if clocks[1] >= confirm:
                clocks[:] = np.array([1.0, 0.0, 0.0])
                S[:, episode] = S[:, 0]
        else:
            clocks[2] = clocks[2] + dt[k] if statistic[k] < 0.7 else 0.0
            if clocks[2] >= clear:
                clocks[:] = 0.0
        i = episode if clocks[0] == 1 else best
        for r in range(R):
            if S[0, i, r] > 0:
                mean[k, r] = S[1, i, r] / S[0, i, r]
                sd[k, r] = _spread(S[:, i, r], offset[r])
        detection[k] = np.int8(clocks[0])
    return statistic, detection, mean, sd
