"""Poison: which of the logs that should be fault-free are not, before anything is fitted on them.

Of each drive k there are the mean residuals r_k by residual and region, their numbers of independent samples
n_k, and the shifts S_k that each supposed fault of a reference size would give them
(:func:`pipeline.guarding.drive_means`). With c what models fitted on other drives would have left,

    r_k = c + S_k x + U l + noise,   var = U diag(o^2) U' + diag(b^2 + s^2 / n_k),

with what tolerances do to each residual, a level and a slope along the shape that the faults' shifts vary
most by (U), lack of fit b between drives, and noise s within one. Models fitted on a
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
    spread = spread_of(drives, np.arange(N))
    members = _trimmed(drives, spread, np.random.default_rng(seed))
    for _ in range(20):
        spread = spread_of(drives, members)
        found = [_evidence(drives, spread, members[members != k], k) for k in range(N)]
        grown = np.flatnonzero([gain <= threshold for _, _, gain in found])
        if len(grown) < LEAST or np.array_equal(grown, members):
            break
        members = grown
    out = [Suspicion(drive=k, fault=f, size=x, T=g) for k, (f, x, g) in enumerate(found) if g > threshold]
    return sorted(out, key=lambda s: -s.T)


@dataclass(frozen=True, eq=False)
class Spread:
    """What healthy drives differ by. ``modes`` (residuals, regions, 2): shapes, a constant and the one that
    the faults' shifts vary most by; their standard deviations (residuals, 2); and those of the lack of fit
    (residuals,)."""

    modes: Array
    sd: Array
    lack: Array


def spread_of(drives: Drives, members: NDArray[np.int64]) -> Spread:
    """Robust, over the members."""
    some = drives.but(members)
    R, modes = some.mean.shape[1], _modes(drives)
    away = some.mean - centre_of(some.mean, some.count)
    sd, lack = np.zeros((R, 2)), np.zeros(R)
    for r in range(R):
        level, var, left = _levels(away[:, r], some.count[:, r] / drives.noise[r] ** 2, modes[r])
        sd[r] = np.sqrt(np.maximum(_sd(level, axis=0) ** 2 - np.median(var, axis=0), 0.0))
        excess = float(_sd(left[some.count[:, r] > 0], axis=0)) ** 2
        noise = drives.noise[r] ** 2 / _typical(some.count[:, r][some.count[:, r] > 0])
        lack[r] = np.sqrt(max(excess - noise, 0.05 * excess))
    sd[:, 0] = np.maximum(sd[:, 0], drives.offset)
    return Spread(modes, np.maximum(sd, 1e-9), np.maximum(lack, 1e-9))


def _modes(drives: Drives) -> Array:
    weight = drives.count.sum(axis=0)
    R, M = weight.shape
    mass = np.maximum(drives.count, 1e-12)[:, None]
    shift = (drives.shift * mass).sum(axis=0) / mass.sum(axis=0)
    modes = np.ones((R, M, 2))
    for r in range(R):
        w = np.sqrt(weight[r] / max(weight[r].sum(), 1e-12))
        S = shift[:, r] / np.maximum(np.linalg.norm(shift[:, r] * w, axis=1, keepdims=True), 1e-12)
        S = (S - (S @ w**2)[:, None]) * w
        shape = np.linalg.svd(S, full_matrices=False)[2][0]
        modes[r, :, 1] = np.where(w > 0, shape / np.maximum(w, 1e-12), 0.0)
    return modes


def _levels(away: Array, precision: Array, modes: Array) -> tuple[Array, Array, Array]:
    """Each drive's coefficients of the modes (drives, 2), their variances, and what is left."""
    A = np.einsum("ma,km,mb->kab", modes, precision, modes)
    A = A + 1e-6 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-12 * np.eye(2)
    cov = np.linalg.inv(A)
    level = np.einsum("kab,mb,km,km->ka", cov, modes, precision, away)
    return level, np.einsum("kaa->ka", cov), away - level @ modes.T


def _typical(count: Array) -> float:
    return float(np.median(count)) if count.size else 1.0


def _sd(x: Array, axis: int) -> Array:
    """Standard deviation from the median absolute deviation."""
    middle = np.nanmedian(x, axis=axis, keepdims=True)
    return np.asarray(1.4826 * np.nanmedian(np.abs(x - middle), axis=axis))


def centre_of(mean: Array, weight: Array) -> Array:
    return np.asarray((mean * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))


def _capped(count: Array, noise: Array, lack: Array) -> Array:
    """Weights of region means: the inverse of their variance, as a number of samples."""
    return np.asarray(count / (1 + count * (lack / noise)[:, None] ** 2))


def _trimmed(drives: Drives, spread: Spread, rng: np.random.Generator) -> NDArray[np.int64]:
    """The members of the least trimmed fit."""
    N, h = len(drives), max(LEAST - 1, round(SHARE * len(drives)))
    weight = _capped(drives.count, drives.noise, spread.lack)
    best, best_sum = np.arange(h), np.inf
    weights = [inverse(drives.count[k], drives.noise, spread, np.zeros(1), 1.0) for k in range(N)]
    for _ in range(STARTS):
        members = rng.choice(N, h, replace=False)
        for _ in range(STEPS):
            away = (drives.mean - centre_of(drives.mean[members], weight[members])).reshape(N, -1)
            distance = np.array([a @ V @ a for a, V in zip(away, weights, strict=True)])
            closest = np.argsort(distance)[:h]
            if set(closest) == set(members):
                break
            members = closest
        if (total := float(np.sort(distance)[:h].sum())) < best_sum:
            best, best_sum = np.sort(members), total
    return best


def inverse(count: Array, noise: Array, spread: Spread, centre_var: Array, more: float) -> Array:
    """V^-1 of a drive, (residuals x regions) squared; regions where it was not count nothing. The modes'
    variance counts ``more`` times."""
    R, M = count.shape
    var = noise[:, None] ** 2 / np.maximum(count, 1e-12) + spread.lack[:, None] ** 2 + centre_var
    precision = np.where(count > 0, 1 / var, 0.0)
    out = np.zeros((R * M, R * M))
    for r in range(R):  # Woodbury, residual by residual
        at = slice(r * M, (r + 1) * M)
        PU = precision[r][:, None] * spread.modes[r]
        inner = np.diag(1 / (more * spread.sd[r] ** 2)) + spread.modes[r].T @ PU
        out[at, at] = np.diag(precision[r]) - PU @ np.linalg.solve(inner, PU.T)
    return out


def _evidence(drives: Drives, spread: Spread, others: NDArray[np.int64], k: int) -> tuple[int, float, float]:
    """The fault with the most evidence in drive k, its size and T, against models of the others."""
    weight = _capped(drives.count[others], drives.noise, spread.lack)
    total = weight.sum(axis=0)
    count = np.where(total > 0, drives.count[k], 0.0)
    centre_var = drives.noise[:, None] ** 2 / np.maximum(total, 1e-12)
    V = inverse(count, drives.noise, spread, centre_var, 1 + 1 / max(len(others), 1))
    S = drives.shift[k].reshape(drives.shift.shape[1], -1)
    away = (drives.mean[k] - centre_of(drives.mean[others], weight)).reshape(-1)
    h, G = S @ V @ away, np.einsum("fi,ij,fj->f", S, V, S)
    gain = np.where((h > 0) & (G > 1e-12), h**2 / np.maximum(G, 1e-12), 0.0)
    f = int(np.argmax(gain))
    return f, float(h[f] / max(G[f], 1e-12)), float(gain[f])
