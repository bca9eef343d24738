"""Portrait: what an input selection was decided on, in numbers that can be drawn (Figs 4.2-4.4).

The correlation of the candidates with each other and with the output; the search's course; the best genes;
and of a smoothly blended model in the selected regressors what it leaves: its distribution and, over
consecutive rows, its power spectrum (P. Welch, IEEE Trans. Audio Electroacoust. 15, 1967). A spectrum that is
not flat means that the past still tells something; a flat one proves nothing where the inputs are white.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from stages.blended import fit_blended
from stages.results import RESIDUAL_EDGES, Chosen
from stages.selecting import Selection, lagged_rows

Array = NDArray[np.float64]
ROWS = 6000  # on which correlations and the model are found
CONSECUTIVE = 20_000  # rows of the longest stretch, for the residual
SEGMENT = 256  # samples of Welch's segments
POINTS = 200  # of a search's course
DIGITS = 4


def portrait(
    name: str,
    segments: Sequence[Array],
    names: Sequence[str],
    output: str,
    selection: Selection,
    seed: int = 0,
) -> Chosen:
    """The portrait of a ``selection`` from ``segments``, stretches without gaps of columns ``names``."""
    from scipy.signal import welch  # slow to import, and detectors without a selection do without it

    space, found = selection.space, selection.found
    lagged = lagged_rows(segments, names, output, space)
    sample = lagged.sample(ROWS, seed)
    longest = max(segments, key=len)[: CONSECUTIVE + lagged.reach]
    row = lagged_rows([longest], names, output, space).sample(CONSECUTIVE)
    centre, scale = sample.mean(axis=0), sample.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    sample, row = (sample - centre) / scale, (row - centre) / scale
    left = _left(sample, row, list(space.columns(found.gene)))
    left = left / (left.std() or 1.0)
    density, _ = np.histogram(left, RESIDUAL_EDGES)
    length = min(SEGMENT, len(left))
    _, power = welch(left, nperseg=length, return_onesided=False)
    history = found.history[:: max(1, -(-len(found.history) // POINTS))]
    return Chosen(
        name=name, output=output, criterion=selection.criterion, proven=found.optimal,
        candidates=tuple(f"{n}(t-{lag})" if lag else f"{n}(t)" for n, lag in space.candidates),
        correlation=tuple(map(_short, sample.T @ sample / len(sample))),
        genes=tuple(space.columns(gene) for gene, _ in found.best), scores=_short([s for _, s in found.best]),
        history=_short([*history, found.history[-1]]),
        residual=_short(density / (len(left) * np.diff(RESIDUAL_EDGES))),
        spectrum=_short(power[1 : length // 2 + 1]),
    )  # fmt: skip


def _left(sample: Array, row: Array, columns: list[int]) -> Array:
    """What a model of the columns, fitted to the sample, leaves of the consecutive rows."""
    if not columns:
        return np.asarray(row[:, -1])
    with threadpool_limits(1, user_api="blas"):
        model = fit_blended(np.ascontiguousarray(sample[:, columns]), np.ascontiguousarray(sample[:, -1]))
    return np.asarray(row[:, -1] - model.predict(row[:, columns]))


def _short(values: Array | Sequence[float]) -> tuple[float, ...]:
    """Numbers that are there to be drawn."""
    return tuple(round(float(v), DIGITS) for v in values)
