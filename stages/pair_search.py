"""Search for two faults at once: Newton's steps on their likelihood.

Where to begin, and whether at all, is said by what each does alone (:mod:`stages.additive`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from stages.additive import Additive
from stages.hypotheses import ELAPSED, Evaluated, Points
from stages.likelihood import log_likelihoods, peak
from stages.pooled import Blend, as_computed, pooled
from stages.relations import familiarity
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA, UNFAMILIAR
from stages.size_grid import Grid

Array = NDArray[np.float64]
SETTLED = 0.02  # standard deviations that a last step of Newton's is at most


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
    def computed(self) -> Evaluated:
        """As :meth:`stages.hypotheses.Points.evaluated`."""
        return self.points.evaluated(self.base)

    def likelihood(self, e: Array, sigma: Array, doubt: Array, blend: Blend | None = None) -> Array:
        """L of each point of ``blend``, of all computed ones by default, shape (points,), from (rows,
        residuals, computed points)."""
        e, sigma, doubt = (np.ascontiguousarray(x) for x in (e, sigma, doubt))
        blend = blend or as_computed(e.shape[2])
        S = pooled((e, sigma, np.log(sigma), doubt), blend, self.shapes, self.weight, self.clip)
        return np.asarray(log_likelihoods(S, self.sd, self.sd))

    @cached_property
    def on_grid(self) -> Array:
        """L at all points of the refined grid."""
        return self.likelihood(*self.computed[:3], Blend(*self.grid[:3]))

    @cached_property
    def plain(self) -> float:
        """L of the log as it is."""
        return float(self.on_grid[0])

    @cached_property
    def singles(self) -> list[tuple[float, float]]:
        """Of each fault alone, its size and the logarithm of its marginal likelihood."""
        found = []
        for sizes, points, count in zip(self.grid.sizes, self.grid.points, self.grid.counts, strict=True):
            x = sizes[:count]
            size, height, sd = peak(x, self.on_grid[points[:count]])
            found.append((size, height + np.log(min(1.0, np.sqrt(2 * np.pi) * sd / (x[-1] - x[0])))))
        return found

    @cached_property
    def most(self) -> float:
        """The largest of them."""
        return max(height for _, height in self.singles)

    @property
    def explained(self) -> float:
        """How much likelier the best fault is than the log as it is."""
        return max(self.most - self.plain, 0.0)

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
            parts = zip(self.part(slice(0, k)).singles, self.part(slice(k, n)).singles, strict=True)
            most = max([most, *(before + after for (_, before), (_, after) in parts)])
        return most

    def part(self, rows: slice, times: float = 1.0) -> Window:
        """Some of the samples, ``times`` as heavy; what is computed of them is kept."""
        values = {c: x[rows] for c, x in self.values.items()}
        part = replace(self, values=values, shapes=self.shapes[rows].copy(), weight=times * self.weight[rows])
        if "computed" in vars(self):
            vars(part)["computed"] = tuple(x[rows] for x in self.computed)
            vars(part)["base"] = {c: x[:, rows] for c, x in self.base.items()}
        return part

    def thinned(self, rows: int) -> Window:
        """About ``rows`` of the samples, evenly, that weigh as much as all."""
        step = len(self.weight) // rows
        return self if step < 2 else self.part(slice(None, None, step), step)

    def trusted(self, known: Array) -> Window:
        """The same samples by a share ``known`` (rows, residuals) of their weight."""
        if (known == 1.0).all():
            return self
        other = replace(self, weight=self.weight * known)
        vars(other).update({k: x for k, x in vars(self).items() if k in ("base", "computed")})
        return other

    def supposing(self, points: Points, grid: Grid) -> Window:
        """The same samples with other hypotheses."""
        other = replace(self, points=points, grid=grid)
        vars(other)["base"] = self.base
        return other

    @cached_property
    def additive(self) -> Additive:
        """What two faults at once would explain, about."""
        likeliest = int(np.argmax([height for _, height in self.singles]))
        sizes = self.grid.sizes[likeliest, : self.grid.counts[likeliest]]
        near = self.grid.points[likeliest, np.abs(sizes - self.singles[likeliest][0]).argmin()]
        return Additive.of(
            self.grid, self.sd, self.computed[:3], self.shapes, self.weight,
            near=int(self.grid.left[near]), clip=self.clip,
        )  # fmt: skip

    def familiar(self, pairs: Sequence[tuple[int, int, Pair]], known_to: float) -> Window:
        """The samples that a single fault or one of the ``pairs`` brings to where relations were trained."""
        novelty = [self.computed[3]]
        for i, j, pair in pairs:
            found = self._undone(i, j, np.array([pair.sizes]))
            novelty.append(self._stacked(found, UNFAMILIAR, 1)[:, :, 0])
        return self.trusted(familiarity(np.nan_to_num(novelty, nan=np.inf).min(axis=0), known_to))

    def _undone(self, i: int, j: int, sizes: Array) -> dict[str, Array]:
        return self.points.undone(self.base, [(i, sizes[:, 0]), (j, sizes[:, 1])])

    def _stacked(self, found: dict[str, Array], kind: str, K: int) -> Array:
        """Columns of all residuals, shape (rows, residuals, K)."""
        stacked = np.empty((len(self.weight), len(self.points.residuals), K))
        for r, name in enumerate(self.points.residuals):
            stacked[:, r] = found[kind + name].T
        return stacked

    def both(self, i: int, j: int, sizes: Array) -> Array:
        """L with hypotheses ``i`` and ``j`` undone one after the other, ``sizes`` (K, 2); shape (K,)."""
        found = self._undone(i, j, sizes)
        e, sigma, doubt = (self._stacked(found, kind, len(sizes)) for kind in (RESIDUAL, SIGMA, MODEL_SD))
        inexact = max(self.points.hypotheses[k].inexact for k in (i, j))
        plain = self._stacked(self.base, RESIDUAL, 1)
        return self.likelihood(e, sigma, np.sqrt(doubt**2 + (inexact * (e - plain)) ** 2))

    def start(self, i: int, j: int, first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
        """The likeliest sizes of two hypotheses among ``first`` and ``second``."""
        sizes = np.array([*product(first, second)])
        x, y = sizes[int(self.both(i, j, sizes).argmax())]
        return float(x), float(y)

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
                step = C @ gradient
                if (np.abs(step) < SETTLED * np.sqrt(np.diag(C))).all():
                    break
                at = at + np.clip(step, -4 * h, 4 * h)
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
