"""Relations: what a healthy system obeys, e.g. ``W_Cyl = f_Cyl(p_Int, n_Eng)`` of (5.36), each one a GSMMS.

Fitted on fault-free training logs; each relation adds its prediction as a column of its own name, and
``<name>.sd``, how far the prediction may be off for want of training data,

    sd^2 = (doubt doubt_f(s) max(1, novelty)^2)^2 + (bend novelty_f(s)^2)^2,

as beyond the trained domain an affine model errs with the square of the distance (``doubt_f novelty_f``:
:mod:`stages.gsmms`, ``bend``: :mod:`stages.bending`). ``<name>.novelty`` is the relation's own or the
regime's, whichever is larger: at an operating point that was never met, no relation can be trusted. One
relation also names the operating regime: column ``regime`` is the best matching unit on its map.
``in_domain`` says that every novelty is at most 1; no sample is thrown away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError, did_you_mean
from ingest.log import TIME, Log
from stages.bending import bend_of
from stages.evaluation import Evaluation
from stages.formula import Formula
from stages.gate import GATE
from stages.gsmms import Combination, Gsmms, fit_gsmms
from stages.normalise import SUFFIX
from stages.partition import Growth, Partition
from stages.select_inputs import SelectInputs
from stages.stage import Arrays, Stage, add_columns, columns
from stages.topology import study

Values = Mapping[str, NDArray[np.float64]]
FAR = 100.0  # as novel as anything
REGIME, IN_DOMAIN, NOVELTY, SD = "regime", "in_domain", ".novelty", ".sd"


def familiarity(novelty: NDArray[np.float64], known_to: float) -> NDArray[np.float64]:
    """How much a sample's evidence counts: 1 up to a novelty of 1, falling to 0 at ``known_to``."""
    known = np.where(novelty < known_to, novelty, known_to)  # a missing or infinite one counts for nothing
    return np.clip((known_to - known) / (known_to - 1.0), 0.0, 1.0)


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


@dataclass(frozen=True, kw_only=True)
class Relations:
    """``relations`` by name; ``regime`` names the one whose map gives the regime; ``map`` are the two signals
    in whose plane the operating map is drawn.

    Raises:
        RecipeError: ``regime`` is not one of the relations, or nothing has been learned yet.
        LogError: the training logs hold too few complete samples.
    """

    version: ClassVar[str] = "5"
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
        """The fitted models by relation; one that held nowhere in the training logs has none."""
        if not self.learned:
            raise RecipeError("relations: nothing learned yet; fit it first")
        arrays = {
            name: {k.removeprefix(f"{name}/"): v for k, v in self.learned.items() if k.startswith(f"{name}/")}
            for name in self.relations
        }
        return {name: Gsmms.from_arrays(found) for name, found in arrays.items() if "theta" in found}

    def inputs(self, name: str) -> tuple[str, ...]:
        """The inputs that a relation was fitted with."""
        return tuple(str(n) for n in self.learned[f"{name}/inputs"])

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        selected: dict[str, tuple[str, ...]] = {}
        for stage in before[0] if before else ():
            if isinstance(stage, SelectInputs):
                selected |= {
                    name: stage.chosen(name) for name in self.relations.keys() & stage.targets.keys()
                }
        return self._fit(blocks, {}, selected)

    def refit(self, blocks: Sequence[Log], /) -> Self:
        partitions = {name: model.partition for name, model in self.models.items()}
        return self._fit(blocks, partitions, {name: self.inputs(name) for name in self.relations})

    def _fit(
        self,
        blocks: Sequence[Log],
        partitions: Mapping[str, Partition],
        selected: Mapping[str, tuple[str, ...]],
    ) -> Self:
        parts = [columns(b) for b in blocks]
        values = {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
        weight = values.get(GATE, np.ones(len(values[self.map[0]])))
        learned: dict[str, NDArray[Any]] = {}
        for name, relation in self.relations.items():
            inputs = selected.get(name) or relation.chosen(values)
            try:
                partition = partitions.get(name)
                found = self.learned.get(f"{name}/study") if partition else None
                found = relation.study(values, inputs, weight) if partition is None else found
                model = relation.settled(found).fit(values, inputs, weight, partition)
            except LogError as error:
                raise LogError(f"relation {name!r}: {error}") from None
            if found is not None:
                learned[f"{name}/study"] = found
            learned[f"{name}/inputs"] = np.array(inputs, dtype="U")
            if model is not None:
                learned |= {f"{name}/{k}": v for k, v in model.to_arrays().items()}
            if name == self.regime:
                learned |= self._describe(model, relation, inputs, values, weight)
            values[name] = _predicted(relation, model, inputs, values)[0]
        return replace(self, learned=learned)

    def _describe(
        self,
        model: Gsmms | None,
        relation: Relation,
        inputs: Sequence[str],
        values: Values,
        weight: NDArray[np.float64],
    ) -> dict[str, NDArray[np.float64]]:
        """Per region: centre in the plane of ``map``, training samples, root mean square error."""
        if model is None:
            raise LogError(f"relation {self.regime!r}, which gives the regime, holds nowhere in the logs")
        S = regressors(values, inputs)
        unit, error = model.partition.assign(S), relation.formulas[0](values) - model.predict(S)
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
        return {*self.map}.union(*(r.needs for r in self.relations.values())) - {TIME, *self.relations}

    @property
    def adds(self) -> set[str]:
        return {REGIME, IN_DOMAIN}.union(*({n, n + SD, n + NOVELTY} for n in self.relations))

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        units = {c: r.unit for n, r in self.relations.items() for c in (n, n + SD) if r.unit}
        return None, add_columns(block, self.compute(columns(block)), units)

    def sources(self) -> dict[str, Set[str]]:
        """Of a prediction: its inputs and where it holds; of spread and novelty also the regime's inputs."""
        everywhere = {n + SUFFIX for n in self.inputs(self.regime)}
        out: dict[str, Set[str]] = {REGIME: everywhere}
        for name, relation in self.relations.items():
            own = {n + SUFFIX for n in self.inputs(name)} | relation.formulas[1].names
            out |= {name: own, name + SD: own | everywhere, name + NOVELTY: own | everywhere}
        return out | {IN_DOMAIN: {n + NOVELTY for n in self.relations}}

    def compute(self, values: Values, wanted: Set[str] | None = None) -> dict[str, NDArray[Any]]:
        added: dict[str, NDArray[Any]] = {}
        everywhere, regime = values.get(self.regime + NOVELTY, np.empty(0)), None
        if wanted is None or REGIME in wanted:
            regime = _evaluated(self.models[self.regime], self.inputs(self.regime), values)
            added[REGIME], everywhere = regime.unit, regime.novelty
        largest = everywhere
        for name, relation in self.relations.items():
            if wanted is not None and wanted.isdisjoint({name, name + SD, name + NOVELTY, IN_DOMAIN}):
                continue
            scope = {**values, **added}
            model = self.models.get(name)
            known = regime if name == self.regime else None
            predicted, doubt, novelty = _predicted(relation, model, self.inputs(name), scope, known)
            bend = (model.bend if model else 0.0) * np.minimum(novelty, FAR) ** 2
            novelty = np.maximum(novelty, everywhere)
            doubt = self.doubt * doubt * np.clip(novelty, 1.0, FAR) ** 2
            sd = np.sqrt(doubt**2 + bend**2)
            added |= {name: predicted, name + SD: sd, name + NOVELTY: novelty}
            largest = np.maximum(largest, novelty)
        return added | {IN_DOMAIN: largest <= 1} if wanted is None or IN_DOMAIN in wanted else added


def _predicted(
    relation: Relation,
    model: Gsmms | None,
    inputs: Sequence[str],
    values: Values,
    known: Evaluation | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Prediction, doubt and novelty, from what the model says if that is ``known``; 0 where the relation does
    not hold, and where it never held in training infinitely novel."""
    if model is not None and relation.everywhere:
        found = known or _evaluated(model, inputs, values)
        return found.prediction, found.doubt, found.novelty
    holds = relation.holds(values)
    if model is None:
        return np.zeros(holds.shape), np.zeros(holds.shape), np.where(holds, np.inf, 0.0)
    found = known or _evaluated(model, inputs, values)
    return (
        np.where(holds, found.prediction, 0.0),
        np.where(holds, found.doubt, 0.0),
        np.where(holds, found.novelty, 0.0),
    )


def _evaluated(model: Gsmms, inputs: Sequence[str], values: Values) -> Evaluation:
    """The model at every row, in the shape of its inputs."""
    given = [values[n + SUFFIX] for n in inputs]
    shape = np.broadcast_shapes(*(x.shape for x in given))
    S = np.empty((*shape, len(given)))
    for j, x in enumerate(given):
        S[..., j] = x
    found = model.evaluate(S.reshape(-1, len(given)))
    return Evaluation(
        found.prediction.reshape(shape), found.doubt.reshape(shape), found.novelty.reshape(shape),
        found.unit.reshape(shape),
    )  # fmt: skip
