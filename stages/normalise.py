"""Normalise: min-max scaling of regressors, (4.21) and (5.23), learned from fault-free training logs.

``x_norm = (x - lo) / (hi - lo)``, so that distances in the operating space weigh every regressor alike.
The scaled copy of a column ``x`` is the column ``x.norm``; the column itself keeps its unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.log import Log
from stages.stage import Arrays, Stage, add_columns, columns

SUFFIX = ".norm"


@dataclass(frozen=True, kw_only=True)
class Normalise:
    """``lo`` and ``hi`` of each of ``columns``; ``tail`` is the share of samples left out at either end, so
    that a single spike does not squeeze the rest (0: the plain minimum and maximum). Those of ``optional``
    may be constant or missing in the training logs; a constant one is scaled by 1.

    Raises:
        RecipeError: ``tail`` is not in [0, 0.5), or nothing has been learned yet.
        LogError: a column is constant or missing throughout the training logs.
    """

    version: ClassVar[str] = "2"
    learns_from: ClassVar[Literal["training"]] = "training"
    columns: tuple[str, ...]
    optional: tuple[str, ...] = ()
    tail: float = 0.0
    learned: Arrays = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 <= self.tail < 0.5:
            raise RecipeError(f"normalise: tail = {self.tail} must be in [0, 0.5)")

    def fit(self, blocks: Sequence[Log], before: Sequence[Sequence[Stage]] = (), /) -> Self:
        lo, hi = [], []
        for name in self.names:
            x = np.concatenate([columns(b, [name])[name] for b in blocks])
            x = x[np.isfinite(x)]
            low, high = np.quantile(x, [self.tail, 1 - self.tail]) if x.size else (0.0, 0.0)
            if not high > low and name in self.optional:
                high = low + 1.0
            if not high > low:
                raise LogError(
                    f"normalise: {name!r} is {'constant' if x.size else 'missing'} in the training logs; "
                    "take it out of the recipe or train on logs in which it varies"
                )
            lo.append(low)
            hi.append(high)
        return replace(self, learned={"lo": np.array(lo), "hi": np.array(hi)})

    def refit(self, blocks: Sequence[Log], /) -> Self:
        return self

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.columns, *self.optional)

    @property
    def needs(self) -> set[str]:
        return set(self.names)

    @property
    def adds(self) -> set[str]:
        return {n + SUFFIX for n in self.names}

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        scaled = self.compute(columns(block, self.names))
        return None, add_columns(block, scaled, dict.fromkeys(scaled, "1"))

    def sources(self) -> dict[str, Set[str]]:
        return {n + SUFFIX: {n} for n in self.names}

    def compute(
        self, values: Mapping[str, NDArray[np.float64]], wanted: Set[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        if not self.learned:
            raise RecipeError("normalise: nothing learned yet; fit it first")
        lo, hi = self.learned["lo"], self.learned["hi"]
        return {
            n + SUFFIX: (values[n] - lo[i]) / (hi[i] - lo[i])
            for i, n in enumerate(self.names)
            if wanted is None or n + SUFFIX in wanted
        }
