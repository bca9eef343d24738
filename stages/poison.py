"""Poison: which of the logs that should be fault-free are not, before anything is fitted on them.

Of each drive k there are the mean residuals r_k by residual and region, their numbers of independent samples
n_k, and the shifts S_k that each supposed fault of a reference size would give them
(:func:`pipeline.guarding.drive_means`). With c what models fitted on other drives would have left,

    r_k = c + S_k x + U l + noise,   var = U diag(o^2) U' + diag(b^2 + s^2 / n_k),

with what tolerances do to each residual, a level and a slope along the shape that the faults' shifts vary
most by (U), lack of fit b between drives, and noise s within one. Models fitted on a
subset only move c, its mean by region; so a fit on any subset costs nothing. Some drives are always judged by
their own spread, as that of all drives takes faults for tolerances.

A least trimmed fit (Rousseeuw 1984; concentration steps after Rousseeuw and Van Driessen 1999) finds the 60 %
of the drives with the likeliest levels and slopes. That set then grows drive by drive (a forward search,
Atkinson and Riani 2000), always by the one (of many a twentieth) with the least evidence for a fault,

    T_k = max_f h^2 / G,   h = S' V^-1 (r - c),   G = S' V^-1 S,

of those with at most half of ``threshold``, as one faulty member widens their spread and lets in the next;
members with more leave it. Only sizes h / G of at least ``TINY`` of the reference count, as tolerances are
no faults. V includes the variance of c, which for members is that without them, and o is that of the members
times what trimming has cut off. What is left is suspicious, each with the fault that has the most evidence,
if that is above ``threshold``, or three quarters of it where another drive has this fault for sure: where one
in ten has it and not one in a hundred, that is as much evidence.

Tolerances hide small faults, a fault in most of the drives is taken for healthy, and nothing can be said of
fewer than ``LEAST`` drives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

Array = NDArray[np.float64]
LEAST = 5
SHARE, STARTS, STEPS = 0.6, 50, 8
THRESHOLD, TINY = 20.0, 0.5
MEMBER, ALIKE = 0.5, 0.75  # of the threshold


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

    @cached_property
    def modes(self) -> Array:
        """What tolerances do, (residuals, regions, 2): a level, and the shape that shifts vary most by."""
        weight = self.count.sum(axis=0)
        R, M = weight.shape
        mass = np.maximum(self.count, 1e-12)[:, None]
        shift = (self.shift * mass).sum(axis=0) / mass.sum(axis=0)
        modes = np.ones((R, M, 2))
        for r in range(R):
            w = np.sqrt(weight[r] / max(weight[r].sum(), 1e-12))
            S = shift[:, r] / np.maximum(np.linalg.norm(shift[:, r] * w, axis=1, keepdims=True), 1e-12)
            S = (S - (S @ w**2)[:, None]) * w
            shape = np.linalg.svd(S, full_matrices=False)[2][0]
            modes[r, :, 1] = np.where(w > 0, shape / np.maximum(w, 1e-12), 0.0)
        return modes

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
    members = _trimmed(drives, np.random.default_rng(seed))
    for _ in range(2 * N):
        cut_off = _cut_off(len(members) / N, 2 * drives.mean.shape[1])
        found = [_evidence(drives, members[members != k], k, cut_off) for k in range(N)]
        grown = _grown(members, np.array([gain for _, _, gain in found]), MEMBER * threshold)
        if len(grown) < LEAST or np.array_equal(grown, members):
            break
        members = grown
    sure = {f for f, _, gain in found if gain > threshold}
    least = [threshold if f not in sure else ALIKE * threshold for f, _, _ in found]
    out = [Suspicion(drive=k, fault=f, size=x, T=g) for k, (f, x, g) in enumerate(found) if g > least[k]]
    return sorted(out, key=lambda s: -s.T)


@dataclass(frozen=True, eq=False)
class Spread:
    """What healthy drives differ by. ``modes`` (residuals, regions, 2): shapes, a constant and the one that
    the faults' shifts vary most by; their standard deviations (residuals, 2); and those of the lack of fit
    (residuals,)."""

    modes: Array
    sd: Array
    lack: Array


def spread_of(drives: Drives, members: NDArray[np.int64], cut_off: float = 1.0) -> Spread:
    """That of the members; ``cut_off`` times what their levels show."""
    some, modes = drives.but(members), drives.modes
    level, var, left = _levels(some, modes, some.mean - centre_of(some.mean, some.count))
    sd = cut_off * np.sqrt(np.maximum(level.var(axis=0) - np.median(var, axis=0), 0.0))
    sd[:, 0] = np.maximum(sd[:, 0], drives.offset)
    lack = np.zeros(len(sd))
    for r, there in enumerate((some.count > 0).swapaxes(0, 1)):
        excess = float((left[:, r][there] ** 2).sum()) / max(there.sum(), 1)
        noise = drives.noise[r] ** 2 / _typical(some.count[:, r][there])
        lack[r] = np.sqrt(max(excess - noise, 0.05 * excess))
    return Spread(modes, np.maximum(sd, 1e-9), np.maximum(lack, 1e-9))


def _cut_off(share: float, dimensions: int) -> float:
    """The standard deviation of normal values over that of the ``share`` nearest to their centre (Croux and
    Haesbroeck 1999)."""
    return float(np.sqrt(share / chi2.cdf(chi2.ppf(share, dimensions), dimensions + 2)))


def _levels(drives: Drives, modes: Array, away: Array) -> tuple[Array, Array, Array]:
    """Each drive's coefficients of the modes and their variances, (drives, residuals, 2), and what is left of
    ``away`` (drives, residuals, regions)."""
    precision = drives.count / drives.noise[:, None] ** 2
    A = np.einsum("rma,krm,rmb->krab", modes, precision, modes)
    least = 1e-6 * np.trace(A, axis1=2, axis2=3) + 1e-12
    cov = np.linalg.inv(A + least[:, :, None, None] * np.eye(2))
    level = np.einsum("krab,krb->kra", cov, np.einsum("rmb,krm->krb", modes, precision * away))
    return level, np.einsum("kraa->kra", cov), away - np.einsum("kra,rma->krm", level, modes)


def _typical(count: Array) -> float:
    return float(np.median(count)) if count.size else 1.0


def centre_of(mean: Array, weight: Array) -> Array:
    return np.asarray((mean * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-12))


def _capped(count: Array, noise: Array, lack: Array) -> Array:
    """Weights of region means: the inverse of their variance, as a number of samples."""
    return np.asarray(count / (1 + count * (lack / noise)[:, None] ** 2))


def _trimmed(drives: Drives, rng: np.random.Generator) -> NDArray[np.int64]:
    """The members of the least trimmed fit, by likelihood: a wide spread explains more and says less. It
    starts from a few drives, as hardly a start with many is without faults."""
    N, h = len(drives), max(LEAST - 1, round(SHARE * len(drives)))
    usual = _unlikely(drives, np.arange(N))[1]
    best, least = np.arange(h), np.inf
    for _ in range(STARTS):
        members = rng.choice(N, LEAST, replace=False)
        for _ in range(STEPS):
            distance, wide = _unlikely(drives, members)
            cost = distance + wide - usual  # how well a drive is known is not what is asked
            closest = np.argsort(cost)[:h]
            if set(closest) == set(members):
                break
            members = closest
        if (total := float(cost[closest].sum())) < least:
            best, least = np.sort(closest), total
    return best


def _unlikely(drives: Drives, members: NDArray[np.int64]) -> tuple[Array, Array]:
    """Minus twice the log likelihood of every drive's levels, for members that are healthy: the distance and
    the normalisation, each (drives,)."""
    away = drives.mean - centre_of(drives.mean[members], drives.count[members])
    level, var, _ = _levels(drives, drives.modes, away)
    square = np.maximum((level[members] ** 2 - var[members]).mean(axis=0), 0.0)
    square[:, 0] = np.maximum(square[:, 0], drives.offset**2)
    total = square + var
    return (level**2 / total).sum(axis=(1, 2)), np.log(total).sum(axis=(1, 2))


def _grown(members: NDArray[np.int64], gain: Array, threshold: float) -> NDArray[np.int64]:
    """The members without those above the threshold, and the other drive with the least evidence below it, of
    many drives as many more as are a twentieth."""
    stay = members[gain[members] <= threshold]
    outside = np.setdiff1d(np.arange(len(gain)), members)
    outside = outside[gain[outside] <= threshold]
    return np.sort(np.append(stay, outside[np.argsort(gain[outside])[: max(1, len(gain) // 20)]]))


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


def _evidence(drives: Drives, others: NDArray[np.int64], k: int, cut_off: float) -> tuple[int, float, float]:
    """The fault with the most evidence in drive k, its size and T, against models and spread of the
    others."""
    spread = spread_of(drives, others, cut_off)
    weight = _capped(drives.count[others], drives.noise, spread.lack)
    total = weight.sum(axis=0)
    count = np.where(total > 0, drives.count[k], 0.0)
    centre_var = drives.noise[:, None] ** 2 / np.maximum(total, 1e-12)
    V = inverse(count, drives.noise, spread, centre_var, 1 + 1 / max(len(others), 1))
    S = drives.shift[k].reshape(drives.shift.shape[1], -1)
    away = (drives.mean[k] - centre_of(drives.mean[others], weight)).reshape(-1)
    h, G = S @ V @ away, np.einsum("fi,ij,fj->f", S, V, S)
    size = h / np.maximum(G, 1e-12)
    gain = np.where((size >= TINY) & (G > 1e-12), h * size, 0.0)
    f = int(np.argmax(gain))
    return f, float(size[f]), float(gain[f])
