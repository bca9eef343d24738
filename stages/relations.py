"""Relations: what a healthy system obeys, e.g. ``W_Cyl = f_Cyl(p_Int, n_Eng)`` of (5.36), each one a GSMMS.

Fitted on fault-free training logs; each relation adds its prediction as a column of its own name, and
``<name>.sd = doubt doubt_f(s) max(1, novelty)^2``, how far the prediction may be off for want of training
data (``doubt_f``: :mod:`stages.gsmms`): beyond the trained domain an affine model errs with the square of the
distance. ``<name>.novelty`` is the relation's own or the regime's, whichever is larger: at an operating point
that was never met, no relation can be trusted. One relation also names the operating regime: column
``regime`` is the best matching unit on its map. ``in_domain`` says that every novelty is at most 1; no sample
is thrown away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError, did_you_mean
from ingest.log import Log
from stages.gate import GATE
from stages.gsmms import Combination, Gsmms, fit_gsmms
from stages.normalise import SUFFIX
from stages.partition import Growth, Partition
from stages.stage import Arrays, Stage, add_columns, columns

REGIME, IN_DOMAIN, NOVELTY, SD = "regime", "in_domain", ".novelty", ".sd"


def familiarity(novelty: NDArray[np.float64], known_to: float) -> NDArray[np.float64]:
    """How much a sample's evidence counts: 1 up to a novelty of 1, falling to 0 at ``known_to``."""
    known = np.where(novelty < known_to, novelty, known_to)  # a missing or infinite one counts for nothing
    return np.clip((known_to - known) / (known_to - 1.0), 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Relation:
    """``output`` as a function of ``inputs`` (columns; their normalised copies are the regressors)."""

    output: str
    inputs: tuple[str, ...]
    unit: str = ""
    nodes: int = 16
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

    def fit(
        self,
        values: Mapping[str, NDArray[np.float64]],
        weight: NDArray[np.float64],
        partition: Partition | None = None,
    ) -> Gsmms:
        growth = Growth(
            nodes=self.nodes, samples_per_parameter=self.samples_per_parameter, max_error=self.max_error
        )
        return fit_gsmms(
            self.regressors(values),
            values[self.output],
            weight,
            growth=growth,
            combination=self.combination,
            neighbourhood=self.neighbourhood,
            partition=partition,
        )

    def regressors(self, values: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        return np.column_stack([values[n + SUFFIX] for n in self.inputs])


@dataclass(frozen=True, kw_only=True)
class Relations:
    """``relations`` by name; ``regime`` names the one whose map gives the regime; ``map`` are the two signals
    in whose plane the operating map is drawn.

    Raises:
        RecipeError: ``regime`` is not one of the relations, or nothing has been learned yet.
        LogError: the training logs hold too few complete samples.
    """

    version: ClassVar[str] = "1"
    learns_from: ClassVar[Literal["training"]] = "training"
    relations: Mapping[str, Relation]
    regime: str
    map: tuple[str, str]
    doubt: float = 2.0
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.regime not in self.relations:
            hint = did_you_mean(self.regime, self.relations)
            raise RecipeError(f"relations: regime = {self.regime!r} is not a relation; {hint}")

    @cached_property
    def models(self) -> dict[str, Gsmms]:
        """The fitted models by relation."""
        if not self.learned:
            raise RecipeError("relations: nothing learned yet; fit it first")
        return {
            name: Gsmms.from_arrays(
                {k.removeprefix(name + "/"): v for k, v in self.learned.items() if k.startswith(name + "/")}
            )
            for name in self.relations
        }

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        return self._fit(blocks, {})

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self._fit(blocks, {name: model.partition for name, model in self.models.items()})

    def _fit(self, blocks: Sequence[Log], partitions: Mapping[str, Partition]) -> Self:
        parts = [columns(b) for b in blocks]
        values = {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
        weight = values.get(GATE, np.ones(len(values[self.map[0]])))
        learned: dict[str, NDArray[Any]] = {}
        for name, relation in self.relations.items():
            try:
                model = relation.fit(values, weight, partitions.get(name))
            except LogError as error:
                raise LogError(f"relation {name!r}: {error}") from None
            learned |= {f"{name}/{k}": v for k, v in model.to_arrays().items()}
            if name == self.regime:
                learned |= self._describe(model, relation, values, weight)
        return replace(self, learned=learned)

    def _describe(
        self,
        model: Gsmms,
        relation: Relation,
        values: Mapping[str, NDArray[np.float64]],
        weight: NDArray[np.float64],
    ) -> dict[str, NDArray[np.float64]]:
        """Per region: centre in the plane of ``map``, training samples, root mean square error."""
        S = relation.regressors(values)
        unit, error = model.partition.assign(S), values[relation.output] - model.predict(S)
        known = (unit >= 0) & np.isfinite(error)
        M = len(model.theta)

        def total(x: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.bincount(unit[known], np.nan_to_num(x[known]), minlength=M), dtype=float)

        visits, mass = total(np.ones(len(unit))), np.maximum(total(weight), 1e-12)
        centre = np.stack([total(weight * values[n]) / mass for n in self.map], axis=1)
        return {
            "map/nodes": centre,
            "map/visits": visits,
            "map/spread": np.sqrt(total(weight * error**2) / mass),
        }

    @property
    def needs(self) -> set[str]:
        return {*self.map}.union(
            *({r.output, *(n + SUFFIX for n in r.inputs)} for r in self.relations.values())
        )

    @property
    def adds(self) -> set[str]:
        return {REGIME, IN_DOMAIN}.union(*({n, n + SD, n + NOVELTY} for n in self.relations))

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        units = {c: r.unit for n, r in self.relations.items() for c in (n, n + SD) if r.unit}
        return None, add_columns(block, self.compute(columns(block)), units)

    def compute(self, values: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[Any]]:
        added: dict[str, NDArray[Any]] = {}
        inputs = {name: relation.regressors(values) for name, relation in self.relations.items()}
        regime = self.models[self.regime]
        everywhere = regime.novelty(inputs[self.regime])
        largest = everywhere
        for name, S in inputs.items():
            model = self.models[name]
            novelty = np.maximum(model.novelty(S), everywhere)
            added |= {name: model.predict(S), name + NOVELTY: novelty}
            added[name + SD] = self.doubt * model.doubt(S) * np.maximum(1.0, novelty) ** 2
            largest = np.maximum(largest, novelty)
        unit = regime.partition.assign(inputs[self.regime])
        return added | {REGIME: unit, IN_DOMAIN: largest <= 1}
