"""What a stage is, and how a log runs through several of them, whole or block by block.

A stage is a frozen dataclass: its fields are the settings. It keeps nothing; what it must remember between
blocks is the state that :meth:`Stage.start` makes and :meth:`Stage.step` hands on. A block is a part of a
log, and a whole log is one block. A block without rows says that the log has ended: what a stage still holds
back comes out. The result never depends on how the log was cut.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any, ClassVar, Literal, Protocol, Self, runtime_checkable

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import TIME, Log, Signal

ANALYSIS = "analysis"  # the one group that stages after `align` work on
Arrays = Mapping[str, NDArray[Any]]


class Stage(Protocol):
    """One step of the chain; ``version`` is raised whenever the output can change.

    ``needs`` and ``adds`` name the columns it reads and makes, so that a recipe can be checked before it
    runs.
    """

    version: ClassVar[str]

    @property
    def needs(self) -> set[str]: ...

    @property
    def adds(self) -> set[str]: ...

    def start(self) -> Any:
        """The state before the first block."""

    def step(self, state: Any, block: Log, /) -> tuple[Any, Log]:
        """The next state, and the block with what this stage adds; neither argument is changed."""


@runtime_checkable
class RowWise(Stage, Protocol):
    """A stage whose new columns at a row depend on that row only."""

    def sources(self) -> Mapping[str, Set[str]]:
        """The columns that each column it adds is made from, in the order in which they are made."""

    def compute(
        self, values: Mapping[str, NDArray[np.float64]], wanted: Set[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        """The columns it adds, at least those ``wanted``, from the columns it needs.

        Columns have the shape (rows,), or (1, rows) and (suppositions, rows) where a column differs between
        suppositions. Of its own columns, those not wanted are taken from ``values``.
        """


@runtime_checkable
class Learner(Stage, Protocol):
    """A stage that needs something learned from fault-free logs before it can step.

    ``learns_from`` says from which: models learn from the ``"training"`` logs, spreads and thresholds from
    ``"calibration"`` logs, that the models have not seen.
    """

    learns_from: ClassVar[Literal["training", "calibration"]]
    learned: Arrays

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]], /) -> Self:
        """The same settings with ``learned`` filled, from whole logs; block i has passed ``before[i]``."""

    def refit(self, blocks: Sequence[Log], /) -> Self:
        """Learned again from other blocks, of the same structure (for held-out predictions)."""


@runtime_checkable
class Connected(Stage, Protocol):
    """A stage that asks the stages before it what they would say about other data."""

    def connect(self, before: Sequence[Stage], /) -> Self:
        """The same stage, knowing the stages before it."""


def connected(stages: Sequence[Stage]) -> list[Stage]:
    """The stages, each that asks for it connected to those before it."""
    out: list[Stage] = []
    for stage in stages:
        out.append(stage.connect(out) if isinstance(stage, Connected) else stage)
    return out


def run_stages(stages: Sequence[Stage], blocks: Iterable[Log]) -> Iterator[Log]:
    """Run ``blocks`` of one log through ``stages`` in order; yields what comes out for each, then the
    rest."""
    states = [stage.start() for stage in stages]
    end: Log | None = None
    for block in blocks:
        end = replace(block, groups={k: replace(g, frame=g.frame.clear()) for k, g in block.groups.items()})
        yield _through(stages, states, block)
    if end is not None:
        yield _through(stages, states, end)


def _through(stages: Sequence[Stage], states: list[Any], block: Log) -> Log:
    for i, stage in enumerate(stages):
        states[i], block = stage.step(states[i], block)
    return block


def transform(stages: Sequence[Stage], log: Log, block_s: float | None = None) -> Log:
    """The whole ``log`` after ``stages``, run in blocks of ``block_s`` seconds (None: one block)."""
    return concat(list(run_stages(stages, [log] if block_s is None else cut(log, block_s))))


def cut(log: Log, block_s: float) -> Iterator[Log]:
    """Parts of ``log`` of ``block_s`` seconds each, in order of time; parts without rows are left out."""
    frames = {k: g.frame.sort(TIME, maintain_order=True) for k, g in log.groups.items()}
    start, end = log.span
    edges = start + block_s * np.arange(1, int((end - start) / block_s) + 2)
    bounds = {k: [0, *np.searchsorted(f[TIME].to_numpy(), edges).tolist()] for k, f in frames.items()}
    for i in range(len(edges)):
        rows = {k: (b[i], b[i + 1] - b[i]) for k, b in bounds.items()}
        if any(count for _, count in rows.values()):
            groups = {k: replace(g, frame=frames[k].slice(*rows[k])) for k, g in log.groups.items()}
            yield replace(log, groups=groups)


def concat(blocks: Sequence[Log]) -> Log:
    """One log from consecutive blocks of it."""
    groups = {}
    for name, first in blocks[0].groups.items():
        parts = [b.groups[name] for b in blocks if b.groups[name].frame.height] or [first]
        if len(parts) > 1:
            frame = pl.concat([g.frame for g in parts], how="vertical_relaxed")
            parts = [replace(first, frame=frame)]
        groups[name] = parts[0]
    return replace(blocks[0], groups=groups)


def columns(block: Log, names: Iterable[str] | None = None) -> dict[str, NDArray[np.float64]]:
    """Columns of the analysis group as float64 arrays, missing values NaN; all numeric ones by default.

    Raises:
        LogError: a name is not there.
    """
    group = block.groups[ANALYSIS]
    wanted = [c for c, t in group.frame.schema.items() if t.is_numeric()] if names is None else names
    return {n: group.time if n == TIME else block.values(n) for n in wanted}


def add_columns(block: Log, added: Mapping[str, NDArray[Any]], units: Mapping[str, str] | None = None) -> Log:
    """The block with more (or replaced) columns in its analysis group."""
    group = block.groups[ANALYSIS]
    units = units or {}
    series = [pl.Series(n, v, nan_to_null=v.dtype.kind == "f") for n, v in added.items()]
    new = {n: Signal(name=n, unit=units.get(n)) for n in added if n not in group.signals or n in units}
    return replace(block, groups={**block.groups, ANALYSIS: group.adding(series, new)})
