"""Signatures: isolate by a table such as Table 5.2, which residuals a fault moves, and which it does
not.

A table row marks every residual ``0`` (stays at zero), ``x`` (moves), ``+`` or ``-`` (moves to that side).
With the remembered mean of residual r in units of its standard deviation, ``z_r = mean_r / mean_sd_r ~
N(mu_r, 1)``, a fault claims ``mu_r = 0`` for the unmarked residuals and ``mu_r ~ N(0, reach^2)`` (or the half
of it with the claimed sign) for the others. The log-likelihood ratio to ``none``, where all ``mu_r = 0``, is

    evidence = sum_{marked} 1/2 [z^2 reach^2 / (1 + reach^2) - ln(1 + reach^2)] + ln 2 Phi(+-z reach / sqrt(1
    + reach^2)),

the last term for signed marks only: a fault that claims less wins where it explains as much. ``unknown`` lets
every residual of the table move and pays ``unknown_penalty`` for that, so it wins where no row fits. While
there is an alarm ``p`` are the posterior probabilities with equal priors over faults and ``unknown``; else
all are 0.

Faults of one row are told apart by how a residual is distributed (Figure 5.12): of a sensor's gain it goes
with the flow, of a leak with what flows through a hole. A fault may give the ``shape`` h of a residual, e =
a h + noise. Over the alarm's samples, with weights w as in :mod:`stages.detect`, the best a explains

    E = (sum w h e / sigma^2)^2 / (2 sum w h^2 / sigma^2),

and a fault's evidence is less by how much its shape explains less than the best of those given for the same
residual. The other test, whether the operating regime is one that the relations were trained in (Figure
5.13), is a row's mark of a residual made of a relation's ``novelty``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from ingest.errors import RecipeError
from ingest.log import TIME, Log
from stages.detect import MEAN, MEAN_SD
from stages.formula import Formula
from stages.residuals import RESIDUAL, SIGMA, residual_names
from stages.results import DETECTION, EVIDENCE, PROBABILITY, UNKNOWN
from stages.stage import add_columns, columns

Array = NDArray[np.float64]
MARKS = ("0", "x", "+", "-")


@dataclass(frozen=True, eq=False)
class SignaturesState:
    """Time of the last row; ``sum w h^2 / sigma^2`` and ``sum w h e / sigma^2`` over the alarm so far, shape
    (2, shapes)."""

    time: float
    sums: Array


@dataclass(frozen=True, kw_only=True)
class Signatures:
    """``table`` maps a fault to its marks by residual; residuals it does not name are ``0``. ``shapes``: by
    fault and residual a formula of the columns that the residual then goes with; ``correlation_s``: noise is
    correlated over this time.

    Raises:
        RecipeError: a mark is not one of ``0 x + -``, a row marks nothing, or a shape is of no fault of the
            table or of a residual that it does not mark.
    """

    version: ClassVar[str] = "2"
    table: Mapping[str, Mapping[str, str]]
    shapes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    reach: float = 10.0
    unknown_penalty: float = 3.0
    correlation_s: float = 2.0

    def __post_init__(self) -> None:
        for fault, marks in self.table.items():
            if bad := {r: m for r, m in marks.items() if m not in MARKS}:
                raise RecipeError(f"signatures: {fault}: marks must be one of {MARKS}, got {bad}")
            if all(m == "0" for m in marks.values()):
                raise RecipeError(f"signatures: {fault} marks no residual; mark at least one with x, + or -")
        for fault, residual in self.formulas:
            marked = {r for r, m in self.table.get(fault, {}).items() if m != "0"}
            if residual not in marked:
                raise RecipeError(
                    f"signatures: {fault} has a shape of {residual!r}, which its row does not mark; "
                    f"it marks {', '.join(sorted(marked)) or 'nothing'}"
                )

    @cached_property
    def formulas(self) -> dict[tuple[str, str], Formula]:
        """Shapes by fault and residual."""
        return {(f, r): Formula(text) for f, some in self.shapes.items() for r, text in some.items()}

    @property
    def needs(self) -> set[str]:
        marked = {RESIDUAL + r for marks in self.table.values() for r in marks}
        return {DETECTION}.union(marked, *(f.names for f in self.formulas.values()))

    @property
    def adds(self) -> set[str]:
        return {EVIDENCE + f for f in self.table} | {PROBABILITY + f for f in (*self.table, UNKNOWN)}

    def start(self) -> SignaturesState:
        return SignaturesState(np.nan, np.zeros((2, len(self.formulas))))

    def step(self, state: SignaturesState, block: Log, /) -> tuple[SignaturesState, Log]:
        names = residual_names(block)
        values = columns(block)
        z = {r: np.nan_to_num(values[MEAN + r] / values[MEAN_SD + r]) for r in names}
        evidence = {fault: self._evidence(marks, z) for fault, marks in self.table.items()}
        state, sums = self._summed(state, values)
        for fault, less in self._distributed(sums).items():
            evidence[fault] = evidence[fault] - less
        marked = {r for marks in self.table.values() for r, mark in marks.items() if mark != "0"}
        free = self._evidence(dict.fromkeys(sorted(marked), "x"), z) - self.unknown_penalty
        stack = np.stack([*evidence.values(), free])
        p = np.exp(stack - logsumexp(stack, axis=0)) * (values[DETECTION] > 0)
        added: dict[str, NDArray[Any]] = {EVIDENCE + f: v.astype(np.float32) for f, v in evidence.items()}
        added |= {PROBABILITY + f: p[i].astype(np.float32) for i, f in enumerate([*evidence, UNKNOWN])}
        return state, add_columns(block, added, dict.fromkeys(added, "1"))

    def _summed(self, state: SignaturesState, values: Mapping[str, Array]) -> tuple[SignaturesState, Array]:
        """The state after the rows, and its sums at each of them, shape (rows, 2, shapes)."""
        time, alarm = values[TIME], values[DETECTION] > 0
        if not time.size:
            return state, np.empty((0, *state.sums.shape))
        dt = np.diff(time, prepend=state.time)
        w = np.where(np.isfinite(dt), np.minimum(dt / self.correlation_s, 1.0), 1.0) * alarm
        added = np.zeros((len(time), *state.sums.shape))
        for k, ((_, r), formula) in enumerate(self.formulas.items()):
            h, e = np.broadcast_to(formula(values), time.shape), values[RESIDUAL + r]
            known = np.isfinite(h) & np.isfinite(e)
            weight = np.where(known, w / values[SIGMA + r] ** 2, 0.0)
            h, e = np.where(known, h, 0.0), np.where(known, e, 0.0)
            added[:, 0, k], added[:, 1, k] = weight * h * h, weight * h * e
        quiet = np.maximum.accumulate(np.where(alarm, -1, np.arange(len(time))))  # the last row without alarm
        total = np.cumsum(added, axis=0)  # an alarm's sums begin with it
        sums = np.where((quiet >= 0)[:, None, None], total - total[quiet], state.sums + total)
        return SignaturesState(float(time[-1]), sums[-1]), sums

    def _distributed(self, sums: Array) -> dict[str, Array]:
        """By how much each fault's shapes explain less than the best ones, shape (rows,)."""
        explained = 0.5 * sums[:, 1] ** 2 / np.maximum(sums[:, 0], 1e-300)
        less: dict[str, Array] = {}
        for k, (fault, residual) in enumerate(self.formulas):
            rivals = [i for i, (_, r) in enumerate(self.formulas) if r == residual]
            lost = explained[:, rivals].max(axis=1) - explained[:, k]
            less[fault] = less.get(fault, 0.0) + lost
        return less

    def _evidence(self, marks: Mapping[str, str], z: Mapping[str, Array]) -> Array:
        share = self.reach**2 / (1 + self.reach**2)
        total = np.zeros_like(next(iter(z.values())))
        for residual, mark in marks.items():
            if mark == "0":
                continue
            total += 0.5 * (share * z[residual] ** 2 - np.log1p(self.reach**2))
            if mark in "+-":
                side = z[residual] if mark == "+" else -z[residual]
                total += np.log(2.0) + log_ndtr(np.sqrt(share) * side)
        return total
