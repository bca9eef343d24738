"""Templates: which indicators a fault changes, and how a window's change is divided into the fault and the
rest.

Indicators are positive. For a fault of relative size m, d = ln(indicator / healthy) is f(m), a curve in the
space of the indicators, which ``eta = ln(1 + m)`` runs along. A window measures d with information I =
P^-1. Its size is the point of the curve that is nearest in that metric, the rest

    r = d - f(eta),    with information    I - I f' f'^T I / (f'^T I f'),    f' = df / d eta,

is the same for every size: a fault that grows from window to window leaves no rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, did_you_mean
from stages.formula import Formula

Array = NDArray[np.float64]
SIZE = "m"
GRID = np.linspace(-2.3, 2.3, 461)  # ln(1 + m): from a tenth to tenfold


class Split(NamedTuple):
    """Size eta and its information; the rest, and the rest's information."""

    eta: float
    weight: float
    rest: Array
    information: Array


@dataclass(frozen=True, kw_only=True)
class Template:
    """``factors`` maps an indicator to the factor by which a fault of relative size ``m`` changes it.

    Raises:
        RecipeError: no factors, an indicator that is not one of ``indicators``, or a factor that cannot be
            read, depends on anything but ``m`` or is not 1 for m = 0.
    """

    fault: str
    factors: Mapping[str, str]
    indicators: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.factors:
            raise RecipeError(f"fault {self.fault}: it changes no indicator; name at least one")
        for name, text in self.factors.items():
            if name not in self.indicators:
                raise RecipeError(f"fault {self.fault}: {name!r}; {did_you_mean(name, self.indicators)}")
            formula = Formula(text)
            if formula.names != {SIZE} or abs(float(formula({SIZE: np.zeros(())})) - 1.0) > 1e-9:
                raise RecipeError(
                    f"fault {self.fault}: {name} = {text!r}; expected a factor that depends on {SIZE} alone "
                    f"and is 1 for {SIZE} = 0"
                )

    @cached_property
    def curve(self) -> Array:
        """f on ``GRID``, shape (grid, indicators); NaN where a factor is not positive."""
        out = np.zeros((GRID.size, len(self.indicators)))
        for name, text in self.factors.items():
            factor = np.asarray(Formula(text)({SIZE: np.expm1(GRID)}))
            out[:, self.indicators.index(name)] = np.log(np.where(factor > 0.0, factor, np.nan))
        return out

    def split(self, d: Array, information: Array) -> Split:
        """A change d (k,) as this fault and the rest."""
        away = d - self.curve
        loss = np.einsum("gi,gi->g", away @ information, away)
        i = int(np.clip(np.nanargmin(loss), 1, GRID.size - 2))
        slope = (self.curve[i + 1] - self.curve[i - 1]) / (GRID[i + 1] - GRID[i - 1])
        along = information @ slope
        weight = float(slope @ along)
        step = float(np.clip(along @ away[i] / weight, GRID[i - 1] - GRID[i], GRID[i + 1] - GRID[i]))
        return Split(
            eta=float(GRID[i] + step),
            weight=weight,
            rest=away[i] - step * slope,
            information=information - np.outer(along, along) / weight,
        )
