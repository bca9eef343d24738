"""Poison: which of the logs that should be fault-free are not, before anything is fitted on them.

Of each drive k there are the mean residuals r_k by residual and region, their numbers of independent samples
n_k, and the shifts S_k that each supposed fault of a reference size would give them
(:func:`pipeline.guarding.drive_means`). With c what models fitted on other drives would have left,

    r_k = c + S_k x + offset + noise,   var = o^2 11' + diag(b^2 + s^2 / n_k),

with an offset o for each residual, lack of fit b between drives, and noise s within one. Models fitted on a
subset only move c, its mean by region; so a fit on any subset costs nothing. A least trimmed fit (Rousseeuw
1984; concentration steps after Rousseeuw and Van Driessen 1999) finds the 60 % of the drives that agree best;
that set then grows by all drives whose evidence for a fault,

    T_k = max_f h^2 / G,   h = S' V^-1 (r - c) > 0,   G = S' V^-1 S,

is at most ``threshold``; V includes the variance of c, which for members is that without them. What is left
is suspicious, each with the fault that has the most evidence.

Tolerances hide small faults, a fault in most of the drives is taken for healthy, and nothing can be said of
fewer than ``LEAST`` drives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEAST = 5
SHARE, STARTS, STEPS = 0.6, 50, 5
THRESHOLD = 25.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Drives:
    """``mean`` and ``count`` (drives, residuals, regions), count 0 where a drive was not; ``shift`` (drives,
    faults, residuals, regions); ``noise`` (residuals,): s; ``offset`` (residuals,): least standard deviation
    of what differs from drive to drive."""

    mean: Array
    count: Array
    shift: Array
    noise: Array
    offset: Array

    def __len__(self) -> int:
        return len(self.mean)

    def but(self, keep: NDArray[np.int64]) -> Drives:
        """Some of the drives."""
        return replace(self, mean=self.mean[keep], count=self.count[keep], shift=self.shift[keep])


@dataclass(frozen=True, kw_only=True)
class Suspicion:
    """A drive, the fault with the most evidence T, and its size in units of the reference size."""

    drive: int
    fault: int
    size: float
    T: float


def suspicious(drives: Drives, threshold: float = THRESHOLD, seed: int = 0) -> list[Suspicion]:
    """The drives that do not agree with the others, strongest first; none of fewer than ``LEAST``."""
    N = len(drives)
    if N < LEAST:
        return []
    spread = _spread(drives, np.arange(N))
    members = _trimmed(drives, spread, np.random.default_rng(seed))
    for _ in range(20):
        spread = _spread(drives, members)
        found = [_evidence(drives, spread, members[members != k], k) for k in range(N)]
        grown = np.flatnonzero([gain <= threshold for _, _, gain in found])
        if len(grown) < LEAST or np.array_equal(grown, members):
            break
        members = grown
    out = [Suspicion(drive=k, fault=f, size=x, T=g) for k, (f, x, g) in enumerate(found) if g > threshold]
    return sorted(out, key=lambda s: -s.T)


@dataclass(frozen=True, eq=False)
class _Spread:
    """Standard deviations of offset and lack of fit, (residuals,) each."""

    offset: Array
    lack: Array


def _spread(drives: Drives, members: NDArray[np.int64]) -> _Spread:
    """Robust, over the members: of each residual's level, and of what is left of its regions."""
    some = drives.but(members)
    weight = some.count
    c = _centre(some.mean, weight)
    away = np.where(weight > 0, some.mean - c, np.nan)
    level = np.nansum(np.nan_to_num(away) * weight, axis=2) / np.maximum(weight.sum(axis=2), 1e-12)
    offset = np.maximum(_sd(level, axis=0), drives.offset)
    left = away - level[:, :, None]
    excess = _sd(np.moveaxis(left, 1, 0).reshape(left.shape[1], -1), axis=1) ** 2
    typical = np.array([_typical(w[w > 0]) for w in np.moveaxis(weight, 1, 0)])
    lack = np.sqrt(np.maximum(excess - drives.noise**2 / typical, 0.05 * excess))
    return _Spread(offset, np.maximum(lack, 1e-9))


def _typical(count: Array) -> float:
    return float(np.median(count)) if count.size else 1.0


def _sd(x: Array, axis: int) -> Array:
    """Standard deviation from the median absolute deviation."""
    middle = np.nanmedian(x, axis=axis, keepdims=True)
    return np.asarray(1.4826 * np.nanmedian(np.abs(x - middle), axis=axis))


def _centre(mean: Array, weight: Array) -> Array:
    return np.asarray((mean * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))


def _capped(count: Array, noise: Array, lack: Array) -> Array:
    """Weights of region means: the inverse of their variance, as a number of samples."""
    return np.asarray(count / (1 + count * (lack / noise)[:, None] ** 2))


def _trimmed(drives: Drives, spread: _Spread, rng: np.random.Generator) -> NDArray[np.int64]:
    """The members of the least trimmed fit."""
    N, h = len(drives), max(LEAST - 1, round(SHARE * len(drives)))
    weight = _capped(drives.count, drives.noise, spread.lack)
    best, best_sum = np.arange(h), np.inf
    inverse = [_inverse(drives.count[k], drives.noise, spread, np.zeros(1), 1.0) for k in range(N)]
    for _ in range(STARTS):
        members = rng.choice(N, h, replace=False)
        for _ in range(STEPS):
            away = (drives.mean - _centre(drives.mean[members], weight[members])).reshape(N, -1)
            distance = np.array([a @ V @ a for a, V in zip(away, inverse, strict=True)])
            closest = np.argsort(distance)[:h]
            if set(closest) == set(members):
                break
            members = closest
        if (total := float(np.sort(distance)[:h].sum())) < best_sum:
            best, best_sum = np.sort(members), total
    return best


def _inverse(count: Array, noise: Array, spread: _Spread, centre_var: Array, offsets: float) -> Array:
    """V^-1 of a drive, (residuals x regions) squared; regions where it was not count nothing. The offset's
    variance counts ``offsets`` times."""
    R, M = count.shape
    var = noise[:, None] ** 2 / np.maximum(count, 1e-12) + spread.lack[:, None] ** 2 + centre_var
    precision = np.where(count > 0, 1 / var, 0.0)
    out = np.zeros((R * M, R * M))
    for r in range(R):  # Sherman and Morrison, residual by residual
        p, at = precision[r], slice(r * M, (r + 1) * M)
        out[at, at] = np.diag(p) - np.outer(p, p) / (1 / (offsets * spread.offset[r] ** 2) + p.sum())
    return out


def _evidence(drives: Drives, spread: _Spread, others: NDArray[np.int64], k: int) -> tuple[int, float, float]:
    """The fault with the most evidence in drive k, its size and T, against models of the others."""
    weight = _capped(drives.count[others], drives.noise, spread.lack)
    total = weight.sum(axis=0)
    count = np.where(total > 0, drives.count[k], 0.0)
    centre_var = drives.noise[:, None] ** 2 / np.maximum(total, 1e-12)
    V = _inverse(count, drives.noise, spread, centre_var, 1 + 1 / max(len(others), 1))
    S = drives.shift[k].reshape(drives.shift.shape[1], -1)
    away = (drives.mean[k] - _centre(drives.mean[others], weight)).reshape(-1)
    h, G = S @ V @ away, np.einsum("fi,ij,fj->f", S, V, S)
    gain = np.where((h > 0) & (G > 1e-12), h**2 / np.maximum(G, 1e-12), 0.0)
    f = int(np.argmax(gain))
    return f, float(h[f] / max(G[f], 1e-12)), float(gain[f])
