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
from stages.evaluation import Evaluation
from stages.gate import GATE
from stages.gsmms import Gsmms
from stages.normalise import SUFFIX
from stages.partition import Partition
from stages.relation import Relation, Values, regressors
from stages.select_inputs import SelectInputs
from stages.stage import Arrays, Stage, add_columns, columns

FAR = 100.0  # as novel as anything
REGIME, IN_DOMAIN, NOVELTY, SD = "regime", "in_domain", ".novelty", ".sd"


def familiarity(novelty: NDArray[np.float64], known_to: float) -> NDArray[np.float64]:
    """How much a sample's evidence counts: 1 up to a novelty of 1, falling to 0 at ``known_to``."""
    known = np.where(novelty < known_to, novelty, known_to)  # a missing or infinite one counts for nothing
    return np.clip((known_to - known) / (known_to - 1.0), 0.0, 1.0)


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
