"""Offsets: how far a healthy system's residuals are off zero for minutes, learned from several logs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ingest.log import TIME, Log
from stages.residuals import RESIDUAL, SIGMA
from stages.stage import columns

Array = NDArray[np.float64]
MIN_LOGS = 3  # fewer do not tell what differs from run to run


def offset_sd(
    blocks: Sequence[Log], residuals: Sequence[str], given: Array, span_s: float, correlation_s: float
) -> Array:
    """Standard deviation of each residual's mean over ``span_s``, shape (residuals,).

    ``sqrt((given^2 + sum_logs mean_spans (m^2 - v)) / (logs + 1))``, where m are weighted means and v is the
    variance that noise of correlation time ``correlation_s`` gives them: what is supposed counts as one log.
    With fewer than ``MIN_LOGS`` different logs it is ``given``.
    """
    if len({block.name for block in blocks}) < MIN_LOGS:
        return given
    square = given**2
    for block in blocks:
        values = columns(block)
        time = values[TIME]
        part = ((time - time[0]) // span_s).astype(int)
        samples = max(1.0, correlation_s / float(np.median(np.diff(time))))
        for i, r in enumerate(residuals):
            e, sigma = values[RESIDUAL + r], values[SIGMA + r]
            weight = np.where(np.isfinite(e), 1 / sigma**2, 0.0)
            S0 = np.maximum(np.bincount(part, weight), 1e-12)
            excess = (np.bincount(part, weight * np.nan_to_num(e)) / S0) ** 2 - samples / S0
            square[i] += max(float(np.average(excess, weights=S0)), 0.0)
    return np.asarray(np.sqrt(square / (len(blocks) + 1)))
