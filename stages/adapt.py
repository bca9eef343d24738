"""Adapt: wear is followed from drive to drive, faults are not learned.

The reference is frozen: the relations as fitted, and the mean residuals c of some commissioning drives of the
vehicle. From there each drive has mean residuals r by residual and region with what healthy drives differ by,
V (:mod:`stages.poison`), the shifts S_f of each supposed fault and S_w of each kind of wear, per unit. Over
the drives with a memory of ``memory`` drives

    G = sum S' V^-1 S,   h = sum S' V^-1 (r - c),   J(z) = z' G z - 2 h' z.

Wear is bounded: its sign, its total, and its growth since the commissioning (``per_100`` drives). The
evidence for a fault is what it explains beyond any such wear, always against the reference,

    T = min_{wear in bounds} J - min_f min_{wear in bounds, size > 0} J.

How wear shows is known roughly (``inexact``): V has that part of the wear followed so far, as often as drives
are remembered.

Two drives in a row with T above ``threshold`` are an alarm; the fault is the best one, the set all within
``near`` of it. Without an alarm, faults that explain the drives as well as the wear does are named beside it:
which of them it is cannot be known.

The wear itself is followed by a Kalman filter, which is the adaptive part: reference + S_w x. Its state are
levels x, kept within the bounds, their rates, and what the reference is off by, as a mean of few drives,

    r - c = S_w (x - o) + noise,   o ~ N(0, G_c^-1),

with G_c the sum over the commissioning's own drives; x grows from zero and o does not. It is fed with the
drives' own G and h, rests while T is above ``threshold``, and goes on after three drives below half of that;
it never stops for good. Nor is a drive learned from that has such evidence by itself, beside the wear that
the drives before it show: a memory of many drives dilutes what begins in one.

A region (or its surroundings beyond the trained domain) that the commissioning has not seen joins the
reference once it has 18 independent samples, from drives with T below half the threshold only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.poison import Drives, Spread, centre_of, inverse, spread_of

Array = NDArray[np.float64]
RESUME, ENOUGH = 3, 18.0  # drives; samples: 6 (d + 1)
PASSES = 60  # of the coordinate descent over two or three unknowns


@dataclass(frozen=True, kw_only=True)
class Wear:
    """``residuals``: what one unit of wear adds to each residual, formulas of a sample's columns; bounds of
    its size: ``total``, and growth in ``per_100`` drives, both in ``unit``; ``inexact``: the part of what it
    adds that may be wrong, region by region (standard deviation)."""

    residuals: Mapping[str, str]
    per_100: float
    total: float
    unit: str = "1"
    inexact: float = 0.3

    def __post_init__(self) -> None:
        if not self.residuals or not self.total > 0 or not self.per_100 > 0:
            raise RecipeError(
                f"wear needs residuals and positive bounds, got {dict(self.residuals)}, "
                f"total = {self.total}, per_100 = {self.per_100}"
            )


@dataclass(frozen=True, kw_only=True)
class Settings:
    """See the module's text; ``slack`` multiplies the growth that wear may show since the commissioning."""

    memory: float = 10.0
    threshold: float = 25.0
    near: float = 6.0
    slack: float = 1.2
    rate_sd: float = 0.02  # per drive, of the rate in units of its bound


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """``centre`` (residuals, regions) with the samples that made it ``seen``, and ``spread``."""

    centre: Array
    seen: Array
    spread: Spread
    noise: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Sums G and h over wears and faults; levels and rates of the wears, what the reference is off by in
    wear, and the covariance of these; drives since the commissioning, drives above the threshold and well
    below it; samples of regions that grow."""

    reference: Reference
    G: Array
    h: Array
    x: Array
    P: Array
    drives: int = 0
    above: int = 0
    calm: int = RESUME
    pending: Array = field(default_factory=lambda: np.empty(0))
    pending_sum: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What is known after a drive: evidence T, whether that is an alarm, the faults it may be, the likeliest
    first, with their sizes in reference units, and the wears with standard deviations. ``learned``: the drive
    was learned from."""

    T: float
    alarm: bool
    faults: Mapping[int, float]
    wear: tuple[float, ...]
    wear_sd: tuple[float, ...]
    learned: bool


def commission(drives: Drives, wear_shift: Array, wears: Sequence[Wear]) -> State:
    """The state after fault-free commissioning drives; ``wear_shift`` (drives, wears, residuals, regions)."""
    every = np.arange(len(drives))
    spread = spread_of(drives, every)
    reference = Reference(
        centre=centre_of(drives.mean, drives.count), seen=drives.count.sum(axis=0), spread=spread,
        noise=drives.noise,
    )  # fmt: skip
    n, W = drives.shift.shape[1] + len(wears), len(wears)
    known = np.diag([w.total**-2.0 for w in wears])
    for count, shift in zip(drives.count, wear_shift, strict=True):
        S = shift.reshape(W, -1)
        known += S @ inverse(count, drives.noise, spread, np.zeros_like(count), 1.0) @ S.T
    bound = np.array([w.per_100 / 100 for w in wears])
    P = np.diag(np.concatenate([np.full(W, 1e-12), (0.5 * bound) ** 2, np.zeros(W)]))
    P[2 * W :, 2 * W :] = np.linalg.inv(known)
    shape = drives.mean.shape[1:]
    return State(
        reference=reference, G=np.zeros((n, n)), h=np.zeros(n), x=np.zeros(3 * W), P=P,
        pending=np.zeros(shape), pending_sum=np.zeros(shape),
    )  # fmt: skip


def follow(
    state: State, drives: Drives, wear_shift: Array, wears: Sequence[Wear], settings: Settings
) -> tuple[State, list[Seen]]:
    """Further drives, one after the other; ``wear_shift`` (drives, wears, residuals, regions)."""
    out = []
    for k in range(len(drives)):
        state, seen = _one(state, drives, k, wear_shift[k], wears, settings)
        out.append(seen)
    return state, out


def _one(
    state: State, drives: Drives, k: int, wear_shift: Array, wears: Sequence[Wear], settings: Settings
) -> tuple[State, Seen]:
    W, ref = len(wears), state.reference
    count = np.where(ref.seen > 0, drives.count[k], 0.0)
    centre_var = ref.noise[:, None] ** 2 / np.maximum(ref.seen, 1e-12)
    wrong = [w.inexact * x * s for w, x, s in zip(wears, state.x, wear_shift, strict=False)]
    lasting = settings.memory * np.square(wrong).sum(axis=0)  # it does not average out
    V = inverse(count, ref.noise, ref.spread, np.where(ref.seen > 0, centre_var, 0.0) + lasting, 1.0)
    S = np.concatenate([wear_shift, drives.shift[k]]).reshape(W + drives.shift.shape[1], -1)
    r = (drives.mean[k] - ref.centre).reshape(-1)
    G, h = S @ V @ S.T, S @ V @ r
    keep = np.exp(-1 / settings.memory)
    top = _bounds(wears, state.drives + 1, settings.slack)
    usual = _least(state.G[:W, :W], state.h[:W], top)[1]
    state = replace(state, G=keep * state.G + G, h=keep * state.h + h, drives=state.drives + 1)
    T, faults, alone = _evidence(state.G, state.h, W, top, settings.near)
    above = state.above + 1 if settings.threshold < T else 0
    calm = state.calm + 1 if 0.5 * settings.threshold > T else 0 if settings.threshold < T else state.calm
    most = max(T, _alone(G, h, usual))
    learned = calm >= RESUME and settings.threshold >= most
    state = replace(state, above=above, calm=calm)
    state = _filtered(state, G[:W, :W], h[:W], wears, top, settings, update=learned)
    if 0.5 * settings.threshold > most:
        state = _grown(state, drives, k, wear_shift)
    alarm = above >= 2
    levels = tuple(float(v) for v in state.x[:W])
    sd = tuple(float(np.sqrt(v)) for v in np.diag(state.P)[:W])
    return state, Seen(
        T=T, alarm=alarm, faults=faults if alarm else alone, wear=levels, wear_sd=sd, learned=learned
    )


def _bounds(wears: Sequence[Wear], drives: int, slack: float) -> Array:
    """The most that each wear may be by now."""
    return np.array([min(w.total, slack * w.per_100 * drives / 100) for w in wears])


def _evidence(
    G: Array, h: Array, W: int, top: Array, near: float
) -> tuple[float, dict[int, float], dict[int, float]]:
    """T; the faults within ``near`` of the best one and their sizes; and those that without wear explain as
    much as wear does, where that is something."""
    base = _least(G[:W, :W], h[:W], top)[0]
    found, alone = {}, {}
    for f in range(W, len(h)):
        if G[f, f] <= 1e-12:
            continue
        both = [*range(W), f]
        cost, z = _least(G[np.ix_(both, both)], h[both], np.append(top, np.inf))
        found[f - W] = (base - cost, float(z[-1]))
        gain = max(h[f], 0.0) ** 2 / G[f, f]
        alone[f - W] = (gain, float(max(h[f], 0.0) / G[f, f]))
    best = max((gain for gain, _ in found.values()), default=0.0)
    order = sorted(found, key=lambda f: -found[f][0])
    named = {f: found[f][1] for f in order if best - near <= found[f][0]}
    beside = {f: size for f, (gain, size) in alone.items() if -base > near and -base - near <= gain}
    return best, named, beside


def _alone(G: Array, h: Array, usual: Array) -> float:
    """The evidence for a fault in one drive, whose wear is the ``usual`` one (wears,)."""
    W = len(usual)
    left, own = h[W:] - G[W:, :W] @ usual, np.diag(G)[W:]
    return float(np.max(np.maximum(left, 0.0) ** 2 / np.maximum(own, 1e-12), initial=0.0))


@njit(cache=True)
def _least(G: Array, h: Array, top: Array) -> tuple[float, Array]:  # pragma: no cover - compiled
    """The least J with 0 <= z <= top, by coordinate descent, and where."""
    z, moved = np.zeros(len(h)), True
    for _ in range(PASSES):
        if not moved:
            break
        moved = False
        for i in range(len(h)):
            if G[i, i] > 1e-12:
                before, left = z[i], h[i] + G[i, i] * z[i]
                for j in range(len(h)):
                    left -= G[i, j] * z[j]
                z[i] = min(max(left / G[i, i], 0.0), top[i])
                moved = moved or abs(z[i] - before) > 1e-12 + 1e-6 * abs(before)
    cost = 0.0
    for i in range(len(h)):
        cost -= 2 * h[i] * z[i]
        for j in range(len(h)):
            cost += G[i, j] * z[i] * z[j]
    return cost, z


def _filtered(
    state: State, G: Array, h: Array, wears: Sequence[Wear], top: Array, settings: Settings, *, update: bool
) -> State:
    """Prediction by one drive, and the update with the drive's own G and h, within the bounds."""
    W = len(wears)
    one, none = np.eye(W), np.zeros((W, W))
    F = np.block([[one, one, none], [none, one, none], [none, none, one]])
    rate = np.array([w.per_100 / 100 for w in wears])
    Q = np.diag(np.concatenate([np.full(W, 1e-14), (settings.rate_sd * rate) ** 2, np.zeros(W)]))
    x, P = F @ state.x, F @ state.P @ F.T + Q
    if update:
        H = np.hstack([one, none, -one])
        P = np.asarray(np.linalg.inv(np.linalg.inv(P) + H.T @ G @ H), dtype=float)
        x = x + P @ H.T @ (h - G @ H @ x)
    x[:W] = np.clip(x[:W], 0.0, top)
    x[W : 2 * W] = np.clip(x[W : 2 * W], 0.0, settings.slack * rate)
    return replace(state, x=x, P=0.5 * (P + P.T))


def _grown(state: State, drives: Drives, k: int, wear_shift: Array) -> State:
    """Regions without a reference gather what is left of their means once the wear is taken off."""
    ref, new = state.reference, (state.reference.seen == 0) & (drives.count[k] > 0)
    if not new.any():
        return state
    left = drives.mean[k] - np.einsum("wrm,w->rm", wear_shift, state.x[: len(wear_shift)])
    pending = state.pending + np.where(new, drives.count[k], 0.0)
    sums = state.pending_sum + np.where(new, drives.count[k] * left, 0.0)
    joins = pending >= ENOUGH
    if joins.any():
        centre = np.where(joins, sums / np.maximum(pending, 1e-12), ref.centre)
        ref = replace(ref, centre=centre, seen=np.where(joins, pending, ref.seen))
        pending, sums = np.where(joins, 0.0, pending), np.where(joins, 0.0, sums)
    return replace(state, reference=ref, pending=pending, pending_sum=sums)
