"""Witness: does the wear that is followed show where it must?

A sensor that drifts as slowly as wear looks like wear in every relation that it is part of. A relation
without it cannot be misled: what the controller does for the same operation, such as how far it closes the
turbine's vanes for the same boost. This is a GSMMS (:mod:`stages.gsmms`) of ``output`` on ``inputs`` near
steady state, fitted on the vehicle's commissioning drives. Of drive k it leaves the mean y_k, to which the
followed wear x_k should have added ``p_k = sum_w wear_w x_kw``. With ``a_j = exp(-(k - j) / MEMORY)``,

    z_k = sum_j a_j (p_j - y_j) / sqrt(s^2 [sum a_j^2 + (sum a_j)^2 / N] + (inexact sum a_j p_j)^2),

where s is the standard deviation between the N commissioning drives, each half of them predicted by a model
of the other. A z above ``LIMIT`` contradicts the wear: what grows is likelier a fault of a sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.formula import Formula
from stages.gate import GATE
from stages.gsmms import Gsmms, fit_gsmms
from stages.partition import Growth

Array = NDArray[np.float64]
LIMIT = 2.5
MEMORY = 20.0  # drives
STEADY = 0.5  # gate of a sample that counts


@dataclass(frozen=True, kw_only=True)
class Witness:
    """``output`` and ``inputs``, formulas of columns; ``wear``: what one unit of each kind adds to the
    output; ``inexact``: the part of that which may be wrong (standard deviation).

    Raises:
        RecipeError: a formula cannot be read.
    """

    output: str
    inputs: tuple[str, ...]
    wear: Mapping[str, float]
    inexact: float = 0.2
    nodes: int = 12

    def __post_init__(self) -> None:
        if not self.inputs or not self.wear:
            raise RecipeError("a witness needs inputs, and what each kind of wear adds to its output")
        assert self.needs

    @property
    def needs(self) -> set[str]:
        return {name for text in (self.output, *self.inputs) for name in Formula(text).names}

    def rows(self, drive: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """Inputs (N, d), output and weights (N,) of a drive's columns, of samples that count; none where it
        lacks a column."""
        if not self.needs <= drive.keys():
            return np.empty((0, len(self.inputs))), np.empty(0), np.empty(0)
        columns = np.column_stack([Formula(text)(drive) for text in (self.output, *self.inputs)])
        gate = np.nan_to_num(drive.get(GATE, np.ones(len(columns))))
        known = np.isfinite(columns).all(axis=1) & (gate >= STEADY)
        return columns[known, 1:], columns[known, 0], gate[known]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sworn:
    """A witness that knows the vehicle: its relation, centre and scale (d,) of the inputs, and the standard
    deviation ``sd`` between the ``drives`` it was fitted on."""

    witness: Witness
    model: Gsmms
    centre: Array
    scale: Array
    drives: int
    sd: float = 0.0

    def mean(self, drive: Mapping[str, Array]) -> float:
        """What is left of a drive's output, of samples in the trained domain; NaN without one."""
        S, y, weight = self.witness.rows(drive)
        if not len(y):
            return float("nan")
        found = self.model.evaluate((S - self.centre) / self.scale)
        weight = weight * (found.novelty <= 1)
        return float(np.average(y - found.prediction, weights=weight)) if weight.any() else float("nan")


def swear_in(witness: Witness, drives: Sequence[Mapping[str, Array]]) -> Sworn | None:
    """The witness after two or more commissioning drives (their columns); None where too few samples count,
    as in logs without its signals."""
    least = 3 * witness.nodes * (len(witness.inputs) + 1)
    if min(sum(len(witness.rows(drive)[1]) for drive in drives[i::2]) for i in (0, 1)) < least:
        return None
    halves = [_fitted(witness, drives[i::2]) for i in (0, 1)]
    left = np.array([halves[1 - k % 2].mean(drive) for k, drive in enumerate(drives)])
    left = left[np.isfinite(left)]
    sd = float(np.sqrt((left**2).mean())) if left.size else float("inf")
    whole = _fitted(witness, drives)
    return Sworn(witness=witness, model=whole.model, centre=whole.centre, scale=whole.scale,
                 drives=len(drives), sd=sd)  # fmt: skip


def _fitted(witness: Witness, drives: Sequence[Mapping[str, Array]]) -> Sworn:
    S, y, weight = (np.concatenate(parts) for parts in zip(*map(witness.rows, drives), strict=True))
    centre, scale = S.mean(axis=0), np.maximum(S.std(axis=0), 1e-12)
    model = fit_gsmms((S - centre) / scale, y, weight, growth=Growth(nodes=witness.nodes))
    return Sworn(witness=witness, model=model, centre=centre, scale=scale, drives=len(drives))


def contradiction(left: Array, expected: Array, sd: float, drives: int, inexact: float) -> Array:
    """z after each drive, shape (drives,), from what is ``left`` of the output (NaN: not heard) and what the
    wear should have added, both (drives,).

    >>> none, p = np.zeros(60), np.full(60, 0.01)
    >>> bool(contradiction(none, p, 0.007, 30, 0.2)[-1] > 3 > 1 > contradiction(p, p, 0.007, 30, 0.2)[-1])
    True
    """
    keep, sums, out = np.exp(-1 / MEMORY), np.zeros(4), np.zeros(len(left))
    for k, (y, p) in enumerate(zip(left, expected, strict=True)):
        sums *= [keep, keep**2, keep, keep]
        if np.isfinite(y):
            sums += [1.0, 1.0, p - y, p]
        n, square, off, wear = sums
        variance = sd**2 * (square + n**2 / drives) + (inexact * wear) ** 2
        out[k] = off / np.sqrt(variance) if variance > 0 else 0.0
    return out
