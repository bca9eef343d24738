"""Regressors: new columns from formulas, such as corrected flows and pressure ratios."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ingest.log import TIME, Log
from stages.formula import Formula
from stages.stage import add_columns, columns


@dataclass(frozen=True, kw_only=True)
class Regressors:
    """``columns`` maps a new column's name to its formula, in order: later ones may use earlier ones.

    Raises:
        RecipeError: a formula cannot be read or names an unknown column.
    """

    version: ClassVar[str] = "1"
    columns: Mapping[str, str]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        assert self.formulas is not None  # a wrong formula is found here, not in the middle of a log

    @cached_property
    def formulas(self) -> dict[str, Formula]:
        return {name: Formula(text) for name, text in self.columns.items()}

    @property
    def needs(self) -> set[str]:
        earlier, needed = {TIME}, set[str]()
        for name, formula in self.formulas.items():
            needed |= formula.names - earlier
            earlier.add(name)
        return needed

    @property
    def adds(self) -> set[str]:
        return set(self.columns)

    def start(self) -> None:
        return None

    def step(self, state: None, block: Log, /) -> tuple[None, Log]:
        return None, add_columns(block, self.compute(columns(block)), self.units)

    def sources(self) -> dict[str, Set[str]]:
        return {name: formula.names for name, formula in self.formulas.items()}

    def compute(
        self, values: Mapping[str, NDArray[np.float64]], wanted: Set[str] | None = None
    ) -> dict[str, NDArray[Any]]:
        added: dict[str, NDArray[Any]] = {}
        scope = dict(values)
        for name, formula in self.formulas.items():
            if wanted is None or name in wanted:
                value = formula(scope)
                shape = np.broadcast_shapes(value.shape, values[TIME].shape)
                added[name] = scope[name] = value if value.shape == shape else np.broadcast_to(value, shape)
        return added
