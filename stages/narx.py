"""NARX: a nonlinear model of each output in the regressors that `select_inputs` selected for it.

The regressors ``s`` are multiplied with a metric T that is fine where the output is curved
(:mod:`stages.curved`), and a GSMMS (:mod:`stages.gsmms`) on ``s T`` predicts the output one step ahead, its
regions made anew in the selected inputs. Both combinations of the local models, ``blended`` and ``hard``, are
also fitted on the first three quarters of the training rows and compared on the rest: ``held_out``.

Columns, as of :mod:`stages.relations`: the prediction by the model's own name, ``<name>.sd = doubt
doubt(s) max(1, novelty)^2``, ``<name>.novelty``, and ``regime`` and ``in_domain``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError, did_you_mean
from ingest.log import Log
from stages.curved import curved_map
from stages.gsmms import Combination, Gsmms, fit_gsmms
from stages.normalise import SUFFIX
from stages.relations import IN_DOMAIN, NOVELTY, REGIME, SD
from stages.select_inputs import SelectInputs
from stages.stage import Arrays, Stage, add_columns, columns

Array = NDArray[np.float64]
COMBINATIONS: tuple[Combination, ...] = get_args(Combination)
TRAINED = 0.75  # share of the rows that the comparison is fitted on


@dataclass(frozen=True, kw_only=True)
class Narx:
    """``models``: the output of each model, by the name of its target in `select_inputs`; ``regime`` names
    the model whose regions are the regimes, ``map`` the two signals in whose plane they are drawn.

    Raises:
        RecipeError: ``regime`` is not one of the models, or nothing has been learned yet.
        LogError: nothing was selected for an output, or there are too few complete samples.
    """

    version: ClassVar[str] = "2"
    learns_from: ClassVar[Literal["training"]] = "training"
    models: Mapping[str, str]
    regime: str
    map: tuple[str, str]
    combination: Combination = "blended"
    doubt: float = 0.5
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.regime not in self.models:
            raise RecipeError(
                f"narx: regime = {self.regime!r} is not a model; {did_you_mean(self.regime, self.models)}"
            )

    def inputs(self, name: str) -> tuple[str, ...]:
        """The regressors of a model."""
        if not self.learned:
            raise RecipeError("narx: nothing learned yet; fit it first")
        return tuple(str(n) for n in self.learned[f"{name}/inputs"])

    def regressors(self, name: str, values: Mapping[str, Array]) -> Array:
        """``s T``, shape (N, d)."""
        S = np.column_stack([values[n + SUFFIX] for n in self.inputs(name)])
        return np.asarray(S @ self.learned[f"{name}/metric"])

    @cached_property
    def fitted(self) -> dict[str, Gsmms]:
        """The models by name."""
        arrays: dict[str, dict[str, NDArray[Any]]] = {name: {} for name in self.models if self.inputs(name)}
        for key, array in self.learned.items():
            name, _, part = key.rpartition("/")
            if name in arrays:
                arrays[name][part] = array
        return {name: Gsmms.from_arrays(parts) for name, parts in arrays.items()}

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        chosen: dict[str, tuple[str, ...]] = {}
        for stage in before[0] if before else ():
            if isinstance(stage, SelectInputs):
                chosen |= {name: stage.chosen(name) for name in self.models.keys() & stage.targets.keys()}
        values = _joined(blocks)
        learned: dict[str, NDArray[Any]] = {}
        for name, output in self.models.items():
            if not chosen.get(name):
                raise LogError(
                    f"model {name!r} has no inputs: none was selected, as nothing explains {output!r} in the "
                    "training logs; or select_inputs has no target of that name"
                )
            S = np.column_stack([values[n + SUFFIX] for n in chosen[name]])
            known = np.isfinite(S).all(axis=1) & np.isfinite(values[output])
            learned |= {
                f"{name}/{k}": v for k, v in _fit(S[known], values[output][known], self.combination).items()
            }
            learned[f"{name}/inputs"] = np.array(chosen[name], dtype="U")
        return self._described(learned, values)

    def refit(self, blocks: Sequence[Log], /) -> Self:
        values, learned = _joined(blocks), dict(self.learned)
        for name, output in self.models.items():
            model = fit_gsmms(
                self.regressors(name, values), values[output], combination=self.combination,
                partition=self.fitted[name].partition,
            )  # fmt: skip
            learned |= {f"{name}/{k}": v for k, v in model.to_arrays().items()}
        return self._described(learned, values)

    def _described(self, learned: Arrays, values: Mapping[str, Array]) -> Self:
        """With what the operating map shows: per region its centre in the plane of ``map``, its samples and
        its root mean square error."""
        whole = replace(self, learned=learned)
        model, S = whole.fitted[self.regime], whole.regressors(self.regime, values)
        unit, error = model.partition.assign(S), values[self.models[self.regime]] - model.predict(S)
        M = len(model.theta)
        known = (unit >= 0) & np.isfinite(error)
        visits = np.bincount(unit[known], minlength=M).astype(float)

        def mean(x: Array) -> Array:
            total = np.bincount(unit[known], np.nan_to_num(x[known]), minlength=M)
            return np.asarray(total / np.maximum(visits, 1.0))

        shown = {
            "map/nodes": np.stack([mean(values[n]) for n in self.map], axis=1),
            "map/visits": visits,
            "map/spread": np.sqrt(mean(error**2)),
        }
        return replace(self, learned={**learned, **shown})

    @property
    def needs(self) -> set[str]:
        return {*self.map, *self.models.values()}

    @property
    def adds(self) -> set[str]:
        return {REGIME, IN_DOMAIN}.union(*({n, n + SD, n + NOVELTY} for n in self.models))

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        values, signals = columns(block), block.signals
        units = {n + k: signals[y].unit or "1" for n, y in self.models.items() for k in ("", SD)}
        found = {name: model.evaluate(self.regressors(name, values)) for name, model in self.fitted.items()}
        regime = found[self.regime]
        added: dict[str, NDArray[Any]] = {REGIME: regime.unit}
        largest = regime.novelty
        for name, at in found.items():
            novelty = np.maximum(at.novelty, regime.novelty)
            sd = self.doubt * at.doubt * np.maximum(1.0, novelty) ** 2
            added |= {name: at.prediction, name + SD: sd, name + NOVELTY: novelty}
            largest = np.maximum(largest, novelty)
        return None, add_columns(block, added | {IN_DOMAIN: largest <= 1}, units)


def _joined(blocks: Sequence[Log]) -> dict[str, Array]:
    parts = [columns(b) for b in blocks]
    return {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}


def _fit(S: Array, y: Array, combination: Combination) -> dict[str, NDArray[Any]]:
    """The metric, the model's arrays, and what each combination leaves on held-out rows, ``held_out``, in the
    order of COMBINATIONS."""
    enough = 3 * (S.shape[1] + 1)
    if len(S) < 2 * enough:
        raise LogError(
            f"{len(S)} complete samples are too few for a model with {S.shape[1]} regressors; at least "
            f"{2 * enough} are needed: take longer or more fault-free logs"
        )
    split = int(TRAINED * len(S))
    T, partition = curved_map(S[:split], y[:split], np.ones(split))
    held_out = []
    for way in COMBINATIONS:
        model = fit_gsmms(S[:split] @ T, y[:split], combination=way, partition=partition)
        held_out.append(np.sqrt(np.mean((y[split:] - model.predict(S[split:] @ T)) ** 2)))
    T, partition = curved_map(S, y, np.ones(len(y)))
    model = fit_gsmms(S @ T, y, combination=combination, partition=partition)
    return {**model.to_arrays(), "metric": T, "held_out": np.array(held_out)}
