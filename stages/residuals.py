"""Residuals: measured against predicted, with the spread that a healthy system shows in the same regime.

A residual is a formula of signals and relations, such as those of (5.40)-(5.41). Its spread ``sigma`` is
learned per operating regime from fault-free calibration logs: the root mean square about zero, weighted by
the gate, of values within 8 robust standard deviations, shrunk to the spread over all regimes as if that had
been seen in ``prior_samples`` further samples. Away from steady state the spread of a sample is ``sigma /
sqrt(gate)``; where a relation is in doubt for want of training data (:mod:`stages.relations`) the residual
inherits that as ``model_sd``, by finite differences. Columns: ``residual.<r>``, ``model_sd.<r>``,
``sigma.<r>`` (all of it), ``z.<r> = residual / sigma``, and ``novelty.<r>``, the largest of its relations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import TIME, Log
from stages.formula import Formula
from stages.gate import GATE
from stages.relations import NOVELTY, REGIME, SD
from stages.stage import ANALYSIS, Arrays, Stage, add_columns, columns

RESIDUAL, MODEL_SD, SIGMA, Z = "residual.", "model_sd.", "sigma.", "z."
UNFAMILIAR = "novelty."
KINDS = (RESIDUAL, MODEL_SD, SIGMA, Z, UNFAMILIAR)
MIN_GATE = 1e-3


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """``residuals`` maps a name to its formula, ``units`` to its unit; ``floor`` is the smallest spread
    allowed.

    Raises:
        RecipeError: a formula cannot be read, or nothing has been learned yet.
        LogError: a residual has no value in the calibration logs.
    """

    version: ClassVar[str] = "2"
    learns_from: ClassVar[Literal["calibration"]] = "calibration"
    residuals: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)
    floor: Mapping[str, float] = field(default_factory=dict)
    trust: Mapping[str, str] = field(default_factory=dict)
    prior_samples: float = 50.0
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        assert self.formulas is not None
        assert self.trusts is not None

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        return {name: Formula(text) for name, text in self.residuals.items()}

    @cached_property
    def trusts(self) -> dict[str, Formula]:
        return {name: Formula(text) for name, text in self.trust.items()}

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        parts = [columns(b) for b in blocks]
        values = {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
        M = int(np.nanmax(values[REGIME], initial=0)) + 1
        sigma = [
            self._spread(name, f(values), values[REGIME], self._weight(name, values), M)
            for name, f in self.formulas.items()
        ]
        return replace(self, learned={"sigma": np.stack(sigma)})

    def _spread(
        self,
        name: str,
        e: NDArray[np.float64],
        regime: NDArray[np.float64],
        gate: NDArray[np.float64],
        M: int,
    ) -> NDArray[np.float64]:
        """Per regime, and last for a regime never met; shape (M + 1,)."""
        known = np.isfinite(e) & (regime >= 0)
        if not known.any():
            raise LogError(
                f"residual {name!r} has no value in the calibration logs; see the signals it needs"
            )
        e, unit, gate = e[known] * np.sqrt(gate[known]), regime[known].astype(int), gate[known]
        robust = 1.4826 * float(np.median(np.abs(e - np.median(e)))) or float(e.std())
        inside = np.abs(e) <= 8 * robust
        e, unit, gate = e[inside], unit[inside], gate[inside]
        square = np.bincount(unit, e**2, minlength=M)
        mass = np.bincount(unit, minlength=M).astype(float)
        overall = square.sum() / max(mass.sum(), 1.0)
        variance = (square + self.prior_samples * overall) / (mass + self.prior_samples)
        sigma = np.sqrt(np.append(variance, overall))
        return np.asarray(np.maximum(sigma, max(self.floor.get(name, 0.0), 1e-12)))

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self.fit(blocks)

    @property
    def needs(self) -> set[str]:
        return {REGIME}.union(*(f.names for f in (*self.formulas.values(), *self.trusts.values())))

    @property
    def adds(self) -> set[str]:
        return {k + r for r in self.residuals for k in KINDS}

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        units = {k + r: self.units.get(r, "1") for r in self.residuals for k in (RESIDUAL, MODEL_SD, SIGMA)}
        return None, add_columns(block, self.compute(columns(block)), units)

    def sources(self) -> dict[str, Set[str]]:
        """Of a residual: of its formula, the relations' spreads and novelties, its trust and the regime."""
        out: dict[str, Set[str]] = {}
        for name, formula in self.formulas.items():
            relations = {n + kind for n in formula.names for kind in (SD, NOVELTY)}
            trust = self.trusts[name].names if name in self.trusts else set()
            made_from = formula.names | relations | trust | {REGIME}
            out |= dict.fromkeys((k + name for k in KINDS), made_from)
        return out

    def compute(
        self, values: Mapping[str, NDArray[np.float64]], wanted: Set[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        if not self.learned:
            raise RecipeError("residuals: nothing learned yet; fit it first")
        table = self.learned["sigma"]
        regime, never_met = values[REGIME], table.shape[1] - 1
        unit = np.where((regime >= 0) & (regime < never_met), regime, never_met).astype(int)
        added: dict[str, NDArray[Any]] = {}
        for i, (name, formula) in enumerate(self.formulas.items()):
            if wanted is not None and wanted.isdisjoint(k + name for k in KINDS):
                continue
            e = formula(values)
            e = np.broadcast_to(e, np.broadcast_shapes(e.shape, unit.shape))
            doubt = _model_variance(formula, values, e)
            sigma = np.sqrt(table[i, unit] ** 2 / self._weight(name, values) + doubt)
            novelty = [values[n + NOVELTY] for n in formula.names if n + NOVELTY in values]
            added |= {
                RESIDUAL + name: e, MODEL_SD + name: np.sqrt(doubt), SIGMA + name: sigma,
                UNFAMILIAR + name: reduce(np.maximum, novelty, np.zeros_like(e)),
            }  # fmt: skip
            if wanted is None or Z + name in wanted:
                added[Z + name] = e / sigma
        return added

    def _weight(self, name: str, values: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """Gate times trust, at least ``MIN_GATE``."""
        weight = np.asarray(values[GATE] if GATE in values else np.ones(values[TIME].shape))
        if name in self.trusts:
            weight = weight * self.trusts[name](values)
        return np.asarray(np.fmax(weight, MIN_GATE))


def _model_variance(
    formula: Formula, values: Mapping[str, NDArray[np.float64]], e: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Variance that the relations' own doubts give a residual, shape of ``e``."""
    square = np.zeros_like(e)
    for name in formula.names:
        if name + SD in values:
            square = square + (formula({**values, name: values[name] + values[name + SD]}) - e) ** 2
    return square


def residual_names(block: Log) -> list[str]:
    """The residuals that a block carries, in order."""
    return [n.removeprefix(RESIDUAL) for n in block.groups[ANALYSIS].signals if n.startswith(RESIDUAL)]
