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
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from ingest.errors import RecipeError
from ingest.log import Log
from stages.detect import MEAN, MEAN_SD
from stages.residuals import RESIDUAL, residual_names
from stages.results import DETECTION, EVIDENCE, PROBABILITY, UNKNOWN
from stages.stage import add_columns, columns

MARKS = ("0", "x", "+", "-")


@dataclass(frozen=True, kw_only=True)
class Signatures:
    """``table`` maps a fault to its marks by residual; residuals it does not name are ``0``.

    Raises:
        RecipeError: a mark is not one of ``0 x + -``, or a row marks nothing.
    """

    version: ClassVar[str] = "1"
    table: Mapping[str, Mapping[str, str]]
    reach: float = 10.0
    unknown_penalty: float = 3.0

    def __post_init__(self) -> None:
        for fault, marks in self.table.items():
            if bad := {r: m for r, m in marks.items() if m not in MARKS}:
                raise RecipeError(f"signatures: {fault}: marks must be one of {MARKS}, got {bad}")
            if all(m == "0" for m in marks.values()):
                raise RecipeError(f"signatures: {fault} marks no residual; mark at least one with x, + or -")

    @property
    def needs(self) -> set[str]:
        return {DETECTION}.union(*({RESIDUAL + r for r in marks} for marks in self.table.values()))

    @property
    def adds(self) -> set[str]:
        return {EVIDENCE + f for f in self.table} | {PROBABILITY + f for f in (*self.table, UNKNOWN)}

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        names = residual_names(block)
        values = columns(block, [DETECTION, *(k + r for r in names for k in (MEAN, MEAN_SD))])
        z = {r: np.nan_to_num(values[MEAN + r] / values[MEAN_SD + r]) for r in names}
        evidence = {fault: self._evidence(marks, z) for fault, marks in self.table.items()}
        marked = {r for marks in self.table.values() for r, mark in marks.items() if mark != "0"}
        free = self._evidence(dict.fromkeys(sorted(marked), "x"), z) - self.unknown_penalty
        stack = np.stack([*evidence.values(), free])
        p = np.exp(stack - logsumexp(stack, axis=0)) * (values[DETECTION] > 0)
        added: dict[str, NDArray[Any]] = {EVIDENCE + f: v.astype(np.float32) for f, v in evidence.items()}
        added |= {PROBABILITY + f: p[i].astype(np.float32) for i, f in enumerate([*evidence, UNKNOWN])}
        return None, add_columns(block, added, dict.fromkeys(added, "1"))

    def _evidence(
        self, marks: Mapping[str, str], z: Mapping[str, NDArray[np.float64]]
    ) -> NDArray[np.float64]:
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
