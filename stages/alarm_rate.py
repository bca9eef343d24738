"""Alarm rate: how far thresholds must be moved for a wanted rate of false alarms.

The statistic over its threshold, in nats, of fault-free logs is cut into spans of ``SPAN_S``; the largest of
each is a peak. Beyond their median u the peaks are taken to be exponential with the mean excess beta, at
least 1, as a likelihood ratio of healthy data exceeds x with a probability of at most exp(-x) (Ville). With n
peaks in H hours, alarms beyond c come at a rate of ``n / 2H exp(-(c - u) / beta)``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError

Array = NDArray[np.float64]
SPAN_S = 300.0
LEAST_SPANS = 8


def peaks(time: Array, statistic: Array) -> Array:
    """The largest statistic in each span of a log; a rest shorter than half a span goes with the last."""
    if not len(time):
        return np.empty(0)
    spans = max(1, round((time[-1] - time[0]) / SPAN_S))
    part = np.minimum(((time - time[0]) // SPAN_S).astype(int), spans - 1)
    largest = np.full(spans, -np.inf)
    np.maximum.at(largest, part, np.where(np.isfinite(statistic), statistic, -np.inf))
    return largest[np.isfinite(largest)]


def shift_for(found: Sequence[Array], hours: float, per_hour: float) -> float:
    """How far to move thresholds for ``per_hour`` false alarms, from the peaks of each log.

    Raises:
        LogError: fewer than ``LEAST_SPANS`` spans.

    >>> x = -np.log(1 - (np.arange(1000) + 0.5) / 1000)     # exponential peaks, 12 an hour
    >>> bool(abs(shift_for([x], 1000 / 12, 0.12) - np.log(100)) < 0.1)
    True
    """
    all_peaks = np.concatenate([*found]) if found else np.empty(0)
    n = len(all_peaks)
    if n < LEAST_SPANS:
        raise LogError(
            f"a rate of false alarms cannot be set from {hours:.2f} h of calibration logs; give at least "
            f"{LEAST_SPANS * SPAN_S / 3600:.2g} h of fault-free logs with --calibrate"
        )
    u = float(np.median(all_peaks))
    beyond = all_peaks[all_peaks > u] - u
    beta = max(float(beyond.mean()) if len(beyond) else 0.0, 1.0)
    at_median = 0.5 * n / hours
    if per_hour >= at_median:
        return float(np.quantile(all_peaks, max(0.0, 1 - per_hour * hours / n)))
    return u + beta * float(np.log(at_median / per_hour))
