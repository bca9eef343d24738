"""Inject: what a healthy log would read with a supposed fault, the inverse of undoing it.

A hypothesis says ``healthy = u(reading; theta)`` for some columns (:mod:`stages.hypotheses`). The reading
with the fault solves ``u(x) = healthy``: secant steps from the healthy value, of which one is enough where u
is affine in x, as for gains and leaks. Everything else stays as it was recorded: how the engine or its
control would answer to the fault is not in it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError
from ingest.log import TIME, Log
from stages.hypotheses import ELAPSED, THETA, Hypothesis
from stages.stage import ANALYSIS, add_columns, columns

Array = NDArray[np.float64]
STEPS, EXACT = 30, 1e-9  # at most so many; relative


def inject(block: Log, hypothesis: Hypothesis, size: float, onset_s: float) -> Log:
    """The block (on the analysis raster, before the stages that a hypothesis is undone through) with a fault
    of ``size`` from ``onset_s`` on its clock on.

    Raises:
        RecipeError: undoing it forgets what was read, as for a stuck valve.
    """
    values = columns(block, hypothesis.needs | {TIME})
    on = values[TIME] >= onset_s
    faulty = readings({c: x[on] for c, x in values.items()}, hypothesis, size)
    added = {}
    for column, x in faulty.items():
        added[column] = values[column].copy()
        added[column][on] = x
    units = {c: s.unit for c in added if (s := block.groups[ANALYSIS].signals[c]).unit}
    return add_columns(block, added, units)


def injectable(hypothesis: Hypothesis) -> bool:
    """Whether undoing a fault tells what had been read; not so where the column is replaced."""
    return all(column in formula.names for column, formula in hypothesis.formulas.items())


def readings(values: Mapping[str, Array], hypothesis: Hypothesis, size: float) -> dict[str, Array]:
    """The columns of ``undo`` as they would read with the fault; ``values`` are healthy, (rows,) each.

    >>> gain = Hypothesis(undo={"W": "W / (1 + theta)"}, sizes=(0.1,))
    >>> readings({"time": np.zeros(1), "W": np.array([50.0])}, gain, 0.1)["W"].round(9)
    array([55.])
    """
    if not injectable(hypothesis):
        raise RecipeError(
            f"a fault that is undone by {dict(hypothesis.undo)} cannot be injected, it forgets the reading"
        )
    time = values[TIME]
    scope = {**values, THETA: np.full(len(time), size), ELAPSED: time - time[:1]}
    target = {c: values[c] for c in hypothesis.undo}
    known = {c: np.isfinite(x) for c, x in target.items()}
    for _ in range(STEPS):
        worst = 0.0
        for column, formula in hypothesis.formulas.items():
            x = scope[column]
            step = 1e-3 * np.maximum(np.abs(x), 1.0)
            now = formula(scope)
            slope = (formula({**scope, column: x + step}) - now) / step
            off = np.where(known[column], target[column] - now, 0.0)
            worst = max(worst, float(np.max(np.abs(off) / np.maximum(np.abs(x), 1.0), initial=0.0)))
            scope = {**scope, column: x + off / np.where(slope == 0, np.inf, slope)}
        if worst < EXACT:
            return {c: scope[c] for c in hypothesis.undo}
    raise RecipeError(f"a fault of size {size:g} undone by {dict(hypothesis.undo)} cannot be injected")
