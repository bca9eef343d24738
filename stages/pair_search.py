"""Search for two faults at once: both are undone at a few sizes, then Newton's steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from stages.hypotheses import ELAPSED, Points
from stages.likelihood import A11, A12, A22, B1, B2, SUMS, D, Q, log_likelihoods, peak
from stages.relations import familiarity
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA, UNFAMILIAR
from stages.size_grid import Grid

Array = NDArray[np.float64]
ALL = slice(None)


@dataclass(frozen=True)
class Pair:
    """Two faults: how evident they are beside the likeliest single fault and beside `unknown`, the logarithm
    of the share of all sizes that theirs make, the sizes and their standard deviations."""

    height: float
    over_unknown: float
    share: float
    sizes: tuple[float, float]
    sds: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Window:
    """Samples to judge by: ``values`` (rows,), ``shapes`` of the offsets (rows, residuals, 2), their
    standard deviations ``sd`` (residuals, 2), ``weight`` (rows, residuals); spikes are held within ``clip``
    spreads."""

    points: Points
    grid: Grid
    values: dict[str, Array]
    shapes: Array
    sd: Array
    weight: Array
    clip: float

    @cached_property
    def base(self) -> dict[str, Array]:
        return self.points.as_it_is(self.values, self.values[ELAPSED])

    @cached_property
    def plain(self) -> Array:
        """The residuals of the log as it is, shape (rows, residuals)."""
        return np.column_stack([self.base[RESIDUAL + r][0] for r in self.points.residuals])

    def likelihood(self, e: Array, sigma: Array, doubt: Array, rows: slice = ALL) -> Array:
        """L of each point, shape (points,), from (rows, residuals, points); spikes are held near zero or the
        rows' mean."""
        known, weight = np.isfinite(e) & np.isfinite(sigma), self.weight[rows, :, None]
        w = np.where(known, weight / sigma**2, 0.0)
        e, ln_sigma = np.nan_to_num(e), np.where(known, np.log(sigma), 0.0)
        mean = (w * e).sum(axis=0) / np.maximum(w.sum(axis=0), 1e-300)
        reach = self.clip * np.nan_to_num(sigma, nan=np.inf)
        e = np.clip(e, np.minimum(mean, 0.0) - reach, np.maximum(mean, 0.0) + reach)
        h1, h2 = self.shapes[rows, :, :1], self.shapes[rows, :, 1:]
        S = np.zeros((e.shape[1], SUMS, e.shape[2] + 1))
        S[:, A11, :-1] = (w * h1**2).sum(axis=0)
        S[:, A12, :-1] = (w * h1 * h2).sum(axis=0)
        S[:, A22, :-1] = (w * h2**2).sum(axis=0)
        S[:, B1, :-1] = (w * h1 * e).sum(axis=0)
        S[:, B2, :-1] = (w * h2 * e).sum(axis=0)
        S[:, Q, :-1] = (w * e**2 + 2.0 * weight * ln_sigma).sum(axis=0)
        S[:, D, :-1] = (w * h1**2 * np.nan_to_num(doubt) ** 2).sum(axis=0)
        return np.asarray(log_likelihoods(S, self.sd, self.sd)[:-1])

    @cached_property
    def computed(self) -> tuple[Array, Array, Array, Array]:
        """As :meth:`stages.hypotheses.Points.evaluate`."""
        return self.points.evaluate(self.values, self.values[ELAPSED])

    @cached_property
    def _refined(self) -> tuple[Array, Array, Array]:
        """Residuals, spreads and doubts at all points of the refined grid."""
        grid, share = self.grid, self.grid.share
        e, sigma, doubt = (
            (1.0 - share) * x[:, :, grid.left] + share * x[:, :, grid.right] for x in self.computed[:3]
        )
        return e, sigma, doubt

    def _peaks(self, rows: slice = ALL) -> list[tuple[float, float]]:
        """Of each fault alone, its size and the logarithm of its marginal likelihood in some ``rows``."""
        e, sigma, doubt = self._refined
        L = self.likelihood(e[rows], sigma[rows], doubt[rows], rows)
        found = []
        for sizes, points, count in zip(self.grid.sizes, self.grid.points, self.grid.counts, strict=True):
            x = sizes[:count]
            size, height, sd = peak(x, L[points[:count]])
            found.append((size, height + np.log(min(1.0, np.sqrt(2 * np.pi) * sd / (x[-1] - x[0])))))
        return found

    @cached_property
    def singles(self) -> list[tuple[float, float]]:
        """Of each fault alone, its size and the logarithm of its marginal likelihood."""
        return self._peaks()

    @cached_property
    def most(self) -> float:
        """The largest of them."""
        return max(height for _, height in self.singles)

    @cached_property
    def explained(self) -> float:
        """How much likelier the best fault is than the log as it is."""
        e, sigma, doubt = (x[:, :, :1] for x in self.computed[:3])
        return max(self.most - float(self.likelihood(e, sigma, doubt)[0]), 0.0)

    def unknown(self, sd: Array) -> float:
        """L of the log as it is with offsets of ``sd`` (residuals, 2), spikes and all."""
        e, sigma, doubt = (x[:, :, :1] for x in self.computed[:3])
        return float(replace(self, sd=sd, clip=np.inf).likelihood(e, sigma, doubt)[0])

    @cached_property
    def alone(self) -> float:
        """The largest, also of faults whose size changes once, after a quarter of the rows, a half or three
        quarters."""
        n, most = len(self.weight), self.most
        for k in (n // 4, n // 2, 3 * n // 4):
            parts = zip(self._peaks(slice(0, k)), self._peaks(slice(k, n)), strict=True)
            most = max([most, *(before + after for (_, before), (_, after) in parts)])
        return most

    def thinned(self, rows: int) -> Window:
        """About ``rows`` of the samples, evenly, that weigh as much as all."""
        step = max(1, len(self.weight) // rows)
        values = {c: x[::step] for c, x in self.values.items()}
        return replace(self, values=values, shapes=self.shapes[::step], weight=step * self.weight[::step])

    def start(
        self, i: int, j: int, first: Sequence[float], second: Sequence[float]
    ) -> tuple[float, tuple[float, float]]:
        """The largest L where two hypotheses have sizes of ``first`` and ``second``, and those."""
        sizes = np.array([*product(first, second)])
        L = self.both(i, j, sizes)
        best = int(L.argmax())
        return float(L[best]), (float(sizes[best, 0]), float(sizes[best, 1]))

    def familiar(self, pairs: Sequence[tuple[int, int, Pair]], known_to: float) -> Window:
        """The samples that a single fault or one of the ``pairs`` brings to where relations were trained."""
        novelty = [self.computed[3]]
        for i, j, pair in pairs:
            found = self._undone(i, j, np.array([pair.sizes]))
            novelty.append(self._stacked(found, UNFAMILIAR, 1)[:, :, 0])
        return self.trusted(familiarity(np.nan_to_num(novelty, nan=np.inf).min(axis=0), known_to))

    def trusted(self, known: Array) -> Window:
        """The same samples by a share ``known`` (rows, residuals) of their weight; what is computed is
        kept."""
        other = replace(self, weight=self.weight * known)
        vars(other).update(
            {k: x for k, x in vars(self).items() if k in ("base", "plain", "computed", "_refined")}
        )
        return other

    def _undone(self, i: int, j: int, sizes: Array) -> dict[str, Array]:
        return self.points.undone(self.base, [(i, sizes[:, 0]), (j, sizes[:, 1])])

    def _stacked(self, found: dict[str, Array], kind: str, K: int) -> Array:
        """Columns of all residuals, shape (rows, residuals, K)."""
        columns = [found[kind + r] for r in self.points.residuals]
        return np.stack([np.broadcast_to(x, (K, len(self.weight))).T for x in columns], axis=1)

    def both(self, i: int, j: int, sizes: Array) -> Array:
        """L with hypotheses ``i`` and ``j`` undone one after the other, ``sizes`` (K, 2); shape (K,)."""
        found = self._undone(i, j, sizes)
        e, sigma, doubt = (self._stacked(found, kind, len(sizes)) for kind in (RESIDUAL, SIGMA, MODEL_SD))
        inexact = max(self.points.hypotheses[k].inexact for k in (i, j))
        doubt = np.sqrt(doubt**2 + (inexact * (e - self.plain[:, :, None])) ** 2)
        return self.likelihood(e, sigma, doubt)

    def refined(self, i: int, j: int, start: Pair | tuple[float, float], steps: int) -> Pair:
        """The pair near ``start`` that is most likely, by Newton's steps on differences."""
        grids = [np.array(self.points.hypotheses[k].sizes) for k in (i, j)]
        at = np.array(start.sizes if isinstance(start, Pair) else start)
        h = np.array([0.5 * np.abs(np.diff(g)).min() for g in grids])
        if isinstance(start, Pair):
            h = np.minimum(h, start.sds)
        low, high = (np.array([f(g) for g in grids]) for f in (np.min, np.max))
        best, top, C = at, -np.inf, np.diag(h**2)
        for _ in range(steps):
            L = self.both(i, j, at + STENCIL * h)
            if L.max() > top:
                best, top = at + STENCIL[int(L.argmax())] * h, float(L.max())
            gradient = np.array([L[1] - L[2], L[3] - L[4]]) / (2 * h)
            H = np.diag([L[1] - 2 * L[0] + L[2], L[3] - 2 * L[0] + L[4]]) / h**2
            H[0, 1] = H[1, 0] = (L[5] - L[6] - L[7] + L[8]) / (4 * h[0] * h[1])
            if (np.linalg.eigvalsh(H) < 0).all():
                C = -np.linalg.inv(H)
                at = at + np.clip(C @ gradient, -4 * h, 4 * h)
                h = np.clip(np.sqrt(np.diag(C)), 0.25 * h, h)
            else:
                at = best
            at = np.clip(at, low, high)
        sds = np.sqrt(np.diag(C))
        width = 2 * np.pi * np.sqrt(max(np.linalg.det(C), 0.0)) / np.prod(high - low)
        share = float(np.log(min(1.0, max(width, 1e-300))))
        return Pair(
            top + share, -np.inf, share, (float(best[0]), float(best[1])), (float(sds[0]), float(sds[1]))
        )


STENCIL = np.array(
    [[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [1, -1], [-1, 1], [-1, -1]], dtype=float
)
