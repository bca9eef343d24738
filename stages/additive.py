"""Two faults at once, about: by what undoing each of them alone does to the residuals.

With e_0 the residuals of the log as it is and ``d_p = e_p - e_0`` what undoing point p (a fault of a size)
adds, two faults undone leave about ``e_0 + d_p + d_q``. With the spreads of the likeliest fault alone, all
sums of :mod:`stages.likelihood` follow from the Gram matrix of what the points add,

    sum w (e_0 + d_p + d_q)^2 = q_0 + 2 k_p + 2 k_q + K_pp + K_qq + 2 K_pq,
    K_pq = sum w d_p d_q,   k_p = sum w e_0 d_p,   q_0 = sum w e_0^2,

for all sizes of all pairs at once. What the likeliest fault leaves of a spike beyond ``clip`` spreads is
taken off e_0. Where residuals are straight lines in the sizes, L is a parabola in them: its vertex through
the grid's best point and its eight neighbours says how much two faults explain, and where to look for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stages.likelihood import A11, A12, A22, B1, B2, SUMS, D, Q, log_likelihoods, peak
from stages.size_grid import Grid

Array = NDArray[np.float64]
EVERY = 2  # which points of the refined grid are looked at
REACH = 4.0  # steps that a vertex may be away from the best of them


@dataclass(frozen=True, eq=False)
class Additive:
    """Sums of the log as it is, (residuals, SUMS), and what points add: ``linear`` (residuals, SUMS, points)
    those of the refined grid, ``gram`` (residuals, computed points, computed points) those computed."""

    grid: Grid
    sd: Array
    plain: Array
    linear: Array
    gram: Array

    @classmethod
    def of(
        cls, grid: Grid, sd: Array, row: tuple[Array, Array, Array], shapes: Array, weight: Array, *,
        near: int, clip: float,
    ) -> Additive:  # fmt: skip
        """From e, sigma and doubt at the computed points, each (rows, residuals, computed points);
        ``near``: the computed point next to the likeliest fault alone."""
        e, sigma, doubt = row
        known = np.isfinite(e[:, :, 0]) & np.isfinite(e[:, :, near]) & np.isfinite(sigma[:, :, near])
        s = np.where(known, sigma[:, :, near], 1.0)
        w = np.where(known, weight / s**2, 0.0)
        left = np.where(known, e[:, :, near], 0.0)
        mean = (w * left).sum(axis=0) / np.maximum(w.sum(axis=0), 1e-300)
        held = np.clip(left, np.minimum(mean, 0.0) - clip * s, np.maximum(mean, 0.0) + clip * s)
        e_0 = np.where(known, e[:, :, 0], 0.0) - (left - held)
        d = np.nan_to_num(e - e[:, :, :1])
        h1, h2 = shapes[:, :, 0], shapes[:, :, 1]
        plain, linear = np.zeros((e.shape[1], SUMS)), np.zeros((e.shape[1], SUMS, e.shape[2]))
        for k, factor in ((A11, h1 * h1), (A12, h1 * h2), (A22, h2 * h2), (B1, h1 * e_0), (B2, h2 * e_0)):
            plain[:, k] = (w * factor).sum(axis=0)
        plain[:, Q] = (w * e_0**2).sum(axis=0)
        for k, factor in ((B1, h1), (B2, h2), (Q, 2.0 * e_0)):
            linear[:, k] = np.einsum("nr,nrp->rp", w * factor, d)
        doubts = np.einsum("nr,nrp->rp", w * h1 * h1, np.nan_to_num(doubt) ** 2)
        plain[:, D], linear[:, D] = doubts[:, 0], doubts - doubts[:, :1]
        by_residual = (np.sqrt(w)[:, :, None] * d).transpose(1, 0, 2)
        gram = by_residual.transpose(0, 2, 1) @ by_residual
        return cls(grid, sd, plain, _between(grid, linear, slice(None)), gram)

    def likelihood(self, p: NDArray[np.int64], q: NDArray[np.int64]) -> Array:
        """L, but for the spreads, of points ``p`` and ``q`` of the refined grid at once, shape (p, q)."""
        first, second = (np.take(self.linear, some, axis=2) for some in (p, q))
        S = first[..., None] + second[:, :, None] + self.plain[:, :, None, None]
        both = _between(self.grid, _between(self.grid, self.gram, q).swapaxes(1, 2), p).swapaxes(1, 2)
        S[:, Q] += self.alone[:, p, None] + self.alone[:, None, q] + 2.0 * both
        np.maximum(S[:, D], 0.0, out=S[:, D])
        L = log_likelihoods(S.reshape(*S.shape[:2], -1), self.sd, self.sd)
        return np.asarray(L).reshape(len(p), len(q))

    @cached_property
    def alone(self) -> Array:
        """K of every point of the refined grid with itself, shape (residuals, points)."""
        a, b, share = self.grid[:3]
        return np.asarray(
            (1.0 - share) ** 2 * self.gram[:, a, a]
            + 2.0 * share * (1.0 - share) * self.gram[:, a, b]
            + share**2 * self.gram[:, b, b]
        )

    def fault(self, f: int) -> tuple[Array, NDArray[np.int64]]:
        """Sizes and points of a fault."""
        count = self.grid.counts[f]
        return self.grid.sizes[f, :count], self.grid.points[f, :count]

    @cached_property
    def single(self) -> float:
        """The largest L of one fault."""
        as_it_is, found = np.zeros(1, dtype=np.int64), []
        for f in range(len(self.grid.counts)):
            sizes, points = self.fault(f)
            found.append(peak(sizes, np.ascontiguousarray(self.likelihood(points, as_it_is)[:, 0]))[1])
        return max(found)

    def pair(self, f: int, g: int, least: tuple[float, float]) -> tuple[float, tuple[float, float]]:
        """How much likelier two faults of sizes not below ``least`` are than the best single one, and their
        sizes then."""
        (x, p), (y, q) = (self.fault(k) for k in (f, g))
        large, wide = np.abs(x) >= least[0], np.abs(y) >= least[1]
        x, p, y, q = x[large][::EVERY], p[large][::EVERY], y[wide][::EVERY], q[wide][::EVERY]
        L = self.likelihood(p, q)
        i, j = (int(k) for k in np.unravel_index(L.argmax(), L.shape))
        best = float(L[i, j]) - self.single, (float(x[i]), float(y[j]))
        if min(L.shape) < 3:
            return best
        i, j = min(max(i, 1), len(x) - 2), min(max(j, 1), len(y) - 2)
        some, others = slice(i - 1, i + 2), slice(j - 1, j + 2)
        height, u, v = _vertex(x[some] - x[i], y[others] - y[j], L[some, others])
        sizes = float(np.clip(x[i] + u, x[0], x[-1])), float(np.clip(y[j] + v, y[0], y[-1]))
        if abs(sizes[0]) < least[0] or abs(sizes[1]) < least[1]:
            return best
        return height - self.single, sizes


def _between(grid: Grid, x: Array, some: slice | NDArray[np.int64]) -> Array:
    """The last axis at ``some`` of the refined grid's points instead of the computed ones."""
    left, right = (np.take(x, side[some].astype(np.intp), axis=-1) for side in grid[:2])
    share = grid.share[some]
    return np.asarray((1.0 - share) * left + share * right)


def _vertex(dx: Array, dy: Array, L: Array) -> tuple[float, float, float]:
    """Height and place of the vertex of the parabola through nine values (3, 3) at ``dx``, ``dy`` (3,), no
    farther than REACH steps; the largest value where there is none."""
    u, v = np.repeat(dx, 3), np.tile(dy, 3)
    terms = np.stack([np.ones(9), u, v, u * u, u * v, v * v], axis=1)
    c_0, c_u, c_v, c_uu, c_uv, c_vv = np.linalg.lstsq(terms, L.ravel(), rcond=None)[0].tolist()
    best, determinant = int(L.argmax()), 4.0 * c_uu * c_vv - c_uv**2
    top = float(L.flat[best])
    if not (c_uu < 0 and determinant > 0):
        return top, float(u[best]), float(v[best])
    x, y = (c_uv * c_v - 2.0 * c_vv * c_u) / determinant, (c_uv * c_u - 2.0 * c_uu * c_v) / determinant
    steps = max(abs(x) / float(np.diff(dx).max()), abs(y) / float(np.diff(dy).max()))
    x, y = (z * min(1.0, REACH / max(steps, 1e-300)) for z in (x, y))
    height = c_0 + c_u * x + c_v * y + c_uu * x * x + c_uv * x * y + c_vv * y * y
    return max(height, top), x, y
