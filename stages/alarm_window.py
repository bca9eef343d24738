"""Samples of an alarm, judged all at once: the likelihood of one fault, of two, or of neither.

The sums are those of :mod:`stages.pooled`, with what relations are in doubt of shared by the samples of a
regime.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.additive import Additive
from stages.hypotheses import ELAPSED, OFFSET, Evaluated, Points, at_points
from stages.likelihood import log_likelihoods, peak
from stages.pooled import Blend, as_computed, pooled
from stages.relations import REGIME, familiarity
from stages.residuals import MODEL_SD, RESIDUAL, SIGMA, UNFAMILIAR
from stages.size_grid import Grid

Array = NDArray[np.float64]


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

    @cached_property
    def split(self) -> tuple[Array, Array, Array, Array]:
        """Of the computed points e, the spread of independent noise, the doubt that samples of a regime share
        and what all samples share of what a hypothesis may be wrong by; each (rows, residuals, points)."""
        e, sigma, doubt, _ = self.computed
        moved, wrong, blur = np.nan_to_num(e - e[:, :, :1]), np.zeros_like(e), np.zeros_like(e)
        for k, h in enumerate(self.points.hypotheses):
            place = self.points.place(k)
            wrong[:, :, place] = h.inexact * moved[:, :, place]
            if h.blurred.names:
                blur[:, :, place] = self._blur(k, self.base) * moved[:, :, place]
        model = np.maximum(doubt**2 - wrong**2, 0.0)
        return e, np.sqrt(sigma**2 - model), np.sqrt(model + blur**2), wrong

    def _blur(self, k: int, found: Mapping[str, Array]) -> Array:
        """Shape (rows, 1, sizes or 1), from what has been ``found`` (sizes or 1, rows)."""
        offsets = {OFFSET + r: self.sd[i, 0] for i, r in enumerate(self.points.residuals)}
        x = np.atleast_2d(self.points.hypotheses[k].blurred({**found, **offsets}))
        return np.broadcast_to(x, (len(x), len(self.weight))).T[:, None, :]

    @cached_property
    def regimes(self) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """The rows in order of their regime in the log as it is, and where each regime starts, and the
        end."""
        regime = self.base[REGIME][0]
        order = np.argsort(regime, kind="stable")
        return order, np.flatnonzero(np.diff(regime[order], prepend=-np.inf, append=np.inf)).astype(np.int64)

    def likelihood(
        self, e: Array, noise: Array, doubt: Array, wrong: Array, blend: Blend | None = None
    ) -> Array:
        """L of each point of ``blend``, of all computed ones by default, shape (points,), from what is in
        :attr:`split`, (rows, residuals, computed points)."""
        order, starts = self.regimes
        e, noise, doubt, wrong = (x[order] for x in (e, noise, doubt, wrong))
        blend, shapes, weight = blend or as_computed(e.shape[2]), self.shapes[order], self.weight[order]
        S = pooled((e, noise, np.log(noise), doubt, wrong), blend, shapes, weight, self.clip, starts)
        return np.asarray(log_likelihoods(S, self.sd, self.sd))

    @cached_property
    def on_grid(self) -> Array:
        """L at all points of the refined grid."""
        return self.likelihood(*self.split, Blend(*self.grid[:3]))

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

    def unknown(self, sd: Array) -> float:
        """L of the log as it is with offsets of ``sd`` (residuals, 2), spikes and all."""
        e, noise, doubt, wrong = (x[:, :, :1] for x in self.split)
        return float(self._but(sd=sd, clip=np.inf).likelihood(e, noise, doubt, wrong)[0])

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
            vars(part)["computed"], vars(part)["split"] = (
                tuple(x[rows] for x in known) for known in (self.computed, self.split)
            )
            vars(part)["base"] = {c: x[:, rows] for c, x in self.base.items()}
        return part

    def _but(self, **changes: Any) -> Window:
        """The same samples and hypotheses, judged otherwise."""
        other = replace(self, **changes)
        same = ("base", "computed", "split", "regimes")
        vars(other).update({k: x for k, x in vars(self).items() if k in same})
        return other

    def thinned(self, rows: int) -> Window:
        """About ``rows`` of the samples, evenly, that weigh as much as all."""
        step = len(self.weight) // rows
        return self if step < 2 else self.part(slice(None, None, step), step)

    def trusted(self, known: Array) -> Window:
        """The same samples by a share ``known`` (rows, residuals) of their weight."""
        if (known == 1.0).all():
            return self
        return self._but(weight=self.weight * known)

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

    def familiar(self, which: NDArray[np.intp], sizes: Array, known_to: float) -> Window:
        """The samples that a single fault or one of the pairs, as in :meth:`both`, brings to where relations
        were trained."""
        found = self.points.undone(self.base, which, sizes)
        pairs = np.nan_to_num(self._stacked(found, UNFAMILIAR, len(which)), nan=np.inf).min(axis=2)
        return self.trusted(familiarity(np.minimum(self.computed[3], pairs), known_to))

    def _stacked(self, found: dict[str, Array], kind: str, K: int) -> Array:
        """Columns of all residuals, shape (rows, residuals, K)."""
        stacked = np.empty((len(self.weight), len(self.points.residuals), K))
        for r, name in enumerate(self.points.residuals):
            stacked[:, r] = found[kind + name].T
        return stacked

    def both(self, which: NDArray[np.intp], sizes: Array) -> Array:
        """L with two hypotheses undone one after the other, of the numbers ``which`` (K, 2) at ``sizes``
        (K, 2); shape (K,)."""
        K, hypotheses = len(which), self.points.hypotheses
        found = self.points.undone(self.base, which, sizes)
        e, sigma, model = (self._stacked(found, kind, K) for kind in (RESIDUAL, SIGMA, MODEL_SD))
        inexact = np.array([h.inexact for h in hypotheses])[which].max(axis=1)
        wrong = inexact * (e - self._stacked(self.base, RESIDUAL, 1))
        doubt = model**2
        for k, h in enumerate(hypotheses):
            if h.blurred.names and (at := (which == k).any(axis=1)).any():
                blur = self._blur(k, at_points(found, h.blurred.names, at))
                doubt[:, :, at] += (blur * self._moved(k, sizes[which == k])) ** 2
        return self.likelihood(e, np.sqrt(sigma**2 - model**2), np.sqrt(doubt), wrong)

    def _moved(self, k: int, sizes: Array) -> Array:
        """About what undoing a hypothesis alone changes, (rows, residuals, sizes)."""
        place, h = self.points.place(k), self.points.hypotheses[k]
        known, e = np.array(h.sizes), self.computed[0]
        right = np.clip(np.searchsorted(known, sizes), 1, len(known) - 1)
        share = (sizes - known[right - 1]) / (known[right] - known[right - 1])
        moved = np.nan_to_num(e[:, :, place] - e[:, :, :1])
        return np.asarray((1 - share) * moved[:, :, right - 1] + share * moved[:, :, right])
