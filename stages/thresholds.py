"""Thresholds that healthy logs exceed with a given probability, from a few of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SUPPOSED = 4  # logs that what is supposed counts as


def thresholds(largest: Array, least: Array, margin: float, risk: float) -> Array:
    """Thresholds (kinds, faults) from the largest evidence of each kind in each log of a calibration, (logs,
    kinds, faults): over each memory, of steps, and, last, over any memory where offsets are known.

    The last is what another log exceeds with probability ``risk``; the others are the ``least`` (kinds - 1,).
    All are ``margin`` or more above the largest.
    """
    known = exceeded(largest[:, -1], risk, least[0])
    given = np.vstack([np.broadcast_to(least[:, None], (len(least), len(known))), known])
    return np.asarray(np.maximum(largest.max(axis=0) + margin, given))


def exceeded(largest: Array, risk: float, after_one: float) -> Array:
    """What the largest evidence in another healthy log exceeds with probability ``risk``, shape (faults,).

    ``largest`` (logs, faults), at least 0, is taken for exponential with unknown mean, whose inverse has a
    gamma distribution: before any log, that of ``SUPPOSED`` with E_0 in all. After n logs with E_i another
    exceeds x with probability

        (1 + x / (E_0 + sum E_i)) ** -(SUPPOSED + n).

    E_0 is such that one log without any evidence leaves ``after_one``, in nats.

    >>> exceeded(np.zeros((1, 1)), 0.003, 12.0).round(3).tolist()
    [12.0]
    >>> exceeded(np.zeros((7, 1)), 0.003, 12.0).round(1).tolist()
    [3.8]
    """
    supposed = after_one / _reach(risk, SUPPOSED + 1)
    return np.asarray(_reach(risk, SUPPOSED + len(largest)) * (supposed + largest.sum(axis=0)))


def _reach(risk: float, logs: int) -> float:
    return float(risk ** (-1 / logs) - 1)
