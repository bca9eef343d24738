"""One relation that a healthy system obeys, ``output = f(inputs)`` where it holds, fitted as a GSMMS.

The stage :mod:`stages.relations` fits several, one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import TIME
from stages.bending import bend_of
from stages.formula import Formula
from stages.gsmms import Combination, Gsmms, fit_gsmms
from stages.normalise import SUFFIX
from stages.partition import Growth, Partition
from stages.topology import study

Values = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, kw_only=True)
class Relation:
    """``output``, a formula of columns and earlier relations, as a function of ``inputs`` (columns; their
    normalised copies are the regressors). What a stage `select_inputs` selects under the relation's
    name takes the place of ``inputs``.

    ``otherwise``: the inputs where the training logs lack one of ``inputs``; ``where``: a formula, the
    relation holds where it is positive, elsewhere the output is 0 (a closed valve); ``weight``: of a training
    sample for the parameters, besides the gate, but not for the domain. Of map ``sizes``, if any, and of how
    regions hang together cross-validation chooses (:mod:`stages.topology`), in place of ``nodes``,
    ``combination`` and ``neighbourhood``.
    """

    output: str
    inputs: tuple[str, ...]
    otherwise: tuple[str, ...] = ()
    where: str = "1"
    weight: str = "1"
    unit: str = ""
    nodes: int = 16
    sizes: tuple[int, ...] = ()
    samples_per_parameter: float = 6.0
    max_error: float = 0.0
    combination: Combination = "blended"
    neighbourhood: float = 0.4

    def __post_init__(self) -> None:
        if self.nodes < 1 or self.samples_per_parameter <= 0 or not self.inputs:
            raise RecipeError(
                f"relation {self.output!r}: needs inputs, nodes >= 1 and samples_per_parameter > 0; got "
                f"inputs = {list(self.inputs)}, nodes = {self.nodes}, "
                f"samples_per_parameter = {self.samples_per_parameter}"
            )
        assert self.formulas is not None

    @cached_property
    def formulas(self) -> tuple[Formula, Formula, Formula]:
        """Output, where and weight."""
        return Formula(self.output), Formula(self.where), Formula(self.weight)

    @property
    def needs(self) -> set[str]:
        columns = {n + SUFFIX for n in (*self.inputs, *self.otherwise)}
        return columns.union(*(f.names for f in self.formulas))

    @cached_property
    def everywhere(self) -> bool:
        """Whether it holds wherever the log is."""
        where = self.formulas[1]
        return not where.names and bool(where({}) > 0)

    def holds(self, values: Values) -> NDArray[np.bool_]:
        """Where the relation says something else than 0, shape (rows,)."""
        value = self.formulas[1](values)
        return np.broadcast_to(value, np.broadcast_shapes(value.shape, values[TIME].shape)) > 0

    def chosen(self, values: Values) -> tuple[str, ...]:
        """``inputs``, unless one is missing throughout and there are others to take."""
        missing = any(not np.isfinite(values[n + SUFFIX]).any() for n in self.inputs)
        return self.otherwise if missing and self.otherwise else self.inputs

    def study(
        self, values: Values, inputs: tuple[str, ...], weight: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """The study of map sizes as :meth:`stages.topology.Study.to_arrays`, if one is wanted."""
        holds = self.holds(values)
        if not self.sizes or not holds.any():
            return None
        output, _, own = (np.broadcast_to(f(values), holds.shape)[holds] for f in self.formulas)
        S = regressors(values, inputs)[holds]
        found = study(S, output, weight[holds], own, self.sizes, self.samples_per_parameter)
        return found.to_arrays()["study"]

    def settled(self, found: NDArray[np.float64] | None) -> Relation:
        """The relation with the structure that a study has chosen."""
        if found is None:
            return self
        nodes, blended, neighbourhood, *_ = found[found[:, -1] == 1][0]
        combination: Combination = "blended" if blended else "hard"
        return replace(self, nodes=int(nodes), combination=combination, neighbourhood=float(neighbourhood))

    def fit(
        self,
        values: Values,
        inputs: tuple[str, ...],
        weight: NDArray[np.float64],
        partition: Partition | None,
    ) -> Gsmms | None:
        """None where it holds nowhere in the training logs."""
        output, _, own = (f(values) for f in self.formulas)
        holds = self.holds(values)
        if not holds.any():
            return None
        growth = Growth(
            nodes=self.nodes, samples_per_parameter=self.samples_per_parameter, max_error=self.max_error
        )
        samples = (
            regressors(values, inputs)[holds], output[holds], weight[holds],
            np.broadcast_to(own, holds.shape)[holds],
        )  # fmt: skip
        model = fit_gsmms(
            *samples, growth=growth, combination=self.combination, neighbourhood=self.neighbourhood,
            partition=partition,
        )  # fmt: skip
        return replace(model, bend=bend_of(model, *samples[:2], samples[2] * samples[3]))


def regressors(values: Values, inputs: Sequence[str]) -> NDArray[np.float64]:
    """The normalised inputs, shape (rows, d)."""
    return np.column_stack([values[n + SUFFIX] for n in inputs])
