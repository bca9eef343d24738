"""Select inputs: which candidate regressors a relation gets, learned from fault-free training logs.

Each target is an output with its candidates: columns as they are (``nb_max = 1``, ``nk_max = 0``), or lags
of inputs and of outputs (:mod:`stages.genes`). What is selected (:mod:`stages.selecting`) goes to the
relation of the target's name (:mod:`stages.relations`), besides the inputs that the recipe gives it;
``fixed`` candidates are always selected. Lagged regressors are columns such as ``u1(t-2).norm``,
standardised, made here; a value without its whole window, after a gap or at the start of a log, is missing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import Log
from stages.gate import GATE
from stages.genes import Space
from stages.lags import GAP_STEPS, segments
from stages.normalise import SUFFIX
from stages.portrait import portrait
from stages.results import Chosen
from stages.selecting import Search, Selection, select
from stages.stage import ANALYSIS, Arrays, Stage, add_columns, columns

Array = NDArray[np.float64]
MIN_GATE = 0.5  # samples further from steady state are not selected on


@dataclass(frozen=True, kw_only=True)
class Target:
    """Candidates of ``output``: the past of ``outputs`` up to ``na_max``, and ``inputs`` with up to
    ``nb_max`` regressors after a delay of up to ``nk_max`` (0: the present value); those ``fixed`` are always
    taken."""

    output: str
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    na_max: int = 0
    nb_max: int = 1
    nk_max: int = 0

    def __post_init__(self) -> None:
        assert self.space is not None  # wrong bounds and names are found here

    @cached_property
    def space(self) -> Space:
        outputs = self.outputs if self.na_max else ()
        return Space.of(
            outputs, self.inputs, na_max=self.na_max, nb_max=self.nb_max, nk_max=self.nk_max, fixed=self.fixed
        )

    @property
    def variables(self) -> tuple[str, ...]:
        """The output and all variables of its candidates."""
        return tuple(dict.fromkeys((self.output, *self.space.outputs, *self.space.inputs)))

    @property
    def lagged(self) -> bool:
        return any(lag for _, lag in self.space.candidates)


@dataclass(frozen=True)
class LagState:
    """Time and values of the last rows, as far back as a regressor reaches."""

    time: Array
    values: Array


@dataclass(frozen=True, kw_only=True)
class SelectInputs:
    """``targets`` by relation; ``search``: how to search.

    Raises:
        RecipeError: bounds or names that are wrong, or nothing has been learned yet.
        LogError: too few complete samples in the training logs, or an output that is constant.
    """

    version: ClassVar[str] = "2"
    learns_from: ClassVar[Literal["training"]] = "training"
    targets: Mapping[str, Target]
    search: Search = field(default_factory=Search)
    learned: Arrays = field(default_factory=dict)

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        learned: dict[str, NDArray[Any]] = {}
        for name, target in self.targets.items():
            try:
                parts = stretches(blocks, target)
                selection = select(parts, target.variables, target.output, target.space, self.search)
            except LogError as error:
                raise LogError(f"select_inputs, {name!r}: {error}") from None
            drawn = portrait(name, parts, target.variables, target.output, selection, self.search.seed)
            learned |= {f"{name}/{k}": v for k, v in _arrays(selection, drawn).items()}
        names = self._lagged
        if names:
            found = [columns(b, names) for b in blocks]
            values = np.column_stack([np.concatenate([f[n] for f in found]) for n in names])
            learned |= {"centre": np.nanmean(values, axis=0), "scale": np.nanstd(values, axis=0)}
            learned["step"] = np.array(
                np.median(np.concatenate([np.diff(b.groups[ANALYSIS].time) for b in blocks]))
            )
        return replace(self, learned=learned)

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self

    def chosen(self, name: str) -> tuple[str, ...]:
        """The columns selected for a target, without the suffix of their scaled copies.

        Raises:
            RecipeError: nothing learned yet.
        """
        if not self.learned:
            raise RecipeError("select_inputs: nothing learned yet; fit it first")
        lagged = self.targets[name].lagged
        return tuple(regressor_name(n, k) if lagged else n for n, k in self._chosen(name))

    def portrait(self, name: str) -> Chosen:
        """What the selection for a target was decided on."""
        return Chosen.from_json(json.loads(str(self.learned[f"{name}/portrait"])))

    def _chosen(self, name: str) -> list[tuple[str, int]]:
        pairs = zip(self.learned[f"{name}/variable"], self.learned[f"{name}/lag"], strict=True)
        return [(str(n), int(k)) for n, k in pairs]

    @property
    def _lagged(self) -> list[str]:
        """Variables of targets with lags."""
        lagged = (t for t in self.targets.values() if t.lagged)
        return list(dict.fromkeys(n for t in lagged for n in (*t.space.outputs, *t.space.inputs)))

    @cached_property
    def _made(self) -> list[tuple[str, int]]:
        """(variable, lag) of the columns made here."""
        targets = [n for n, t in self.targets.items() if t.lagged and self.learned]
        return list(dict.fromkeys(pair for n in targets for pair in self._chosen(n)))

    @property
    def needs(self) -> set[str]:
        static = {n + SUFFIX for t in self.targets.values() if not t.lagged for n in t.space.inputs}
        return static.union(*({*t.variables} for t in self.targets.values()))

    @property
    def adds(self) -> set[str]:
        return {regressor_name(n, k) + SUFFIX for n, k in self._made}

    def start(self) -> LagState:
        return LagState(np.empty(0), np.empty((0, len(self._lagged))))

    def step(self, state: LagState, block: Log, /) -> tuple[LagState, Log]:
        if not self.learned:
            raise RecipeError("select_inputs: nothing learned yet; fit it first")
        if not self._made:
            return state, block
        names = self._lagged
        time = block.groups[ANALYSIS].time
        values = np.column_stack(list(columns(block, names).values()))
        z = (values - self.learned["centre"]) / self.learned["scale"]
        z, t, n = np.vstack([state.values, z]), np.concatenate([state.time, time]), len(time)
        unbroken = _unbroken(t, float(self.learned["step"]))[len(t) - n :]
        at = np.arange(len(t) - n, len(t))
        added = {
            regressor_name(v, lag) + SUFFIX: np.where(
                unbroken >= lag, z[np.maximum(at - lag, 0), names.index(v)], np.nan
            )
            for v, lag in self._made
        }
        keep = max(lag for _, lag in self._made)
        kept = slice(max(len(t) - keep, 0), len(t))
        return LagState(t[kept], z[kept]), add_columns(block, added, dict.fromkeys(added, "1"))

    def sources(self) -> dict[str, Set[str]]:
        return dict.fromkeys(self.adds, self.needs)

    def compute(
        self, values: Mapping[str, NDArray[np.float64]], wanted: Set[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        if self._made:
            raise RecipeError(
                "select_inputs: a fault cannot be undone in lagged regressors; use `detect`, not `isolate`"
            )
        return {}


def stretches(blocks: Sequence[Log], target: Target) -> list[Array]:
    """The variables of a target, complete and without a gap, from blocks (logs on the analysis raster); of
    targets without lags only the samples at rest.

    Raises:
        LogError: a variable is not there.
    """
    found: list[Array] = []
    for block in blocks:
        values = np.column_stack(list(columns(block, target.variables).values()))
        if GATE in block.groups[ANALYSIS].signals and not target.lagged:
            values = values[block.values(GATE) >= MIN_GATE]
            found += [values[np.isfinite(values).all(axis=1)]]
        else:
            found += segments(block.groups[ANALYSIS].time, values)
    return found


def regressor_name(variable: str, lag: int) -> str:
    """The column of a lagged variable.

    >>> regressor_name("u1", 2), regressor_name("u1", 0)
    ('u1(t-2)', 'u1(t)')
    """
    return f"{variable}(t-{lag})" if lag else f"{variable}(t)"


def _unbroken(time: Array, step: float) -> NDArray[np.int64]:
    """How many samples before each one follow each other without a gap."""
    at = np.arange(len(time))
    late = np.diff(time, prepend=time[0] if len(time) else 0.0) > GAP_STEPS * step
    late[:1] = True
    return at - np.maximum.accumulate(np.where(late, at, 0))


def _arrays(selection: Selection, drawn: Chosen) -> dict[str, NDArray[Any]]:
    """What is kept of a selection."""
    pairs = selection.structure.regressors
    return {
        "variable": np.array([n for n, _ in pairs], dtype="U"),
        "lag": np.array([k for _, k in pairs], dtype=np.int64),
        "notes": np.array(selection.notes, dtype="U"),
        "portrait": np.array(json.dumps(asdict(drawn))),
    }
