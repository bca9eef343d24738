"""Trend: level and slope of a quantity measured once a window, a Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEVEL_SD, SLOPE_SD = 0.005, 0.003  # by how much a logarithm may depart from its trend in a window


@dataclass(frozen=True, kw_only=True, eq=False)
class Trend:
    """``state``: level at the last window's centre and slope by window, with ``covariance`` (2, 2).

    ``still``: the covariance (2, 2) of the state's error if the level is at rest, which the filter does not
    take for granted.

    >>> trend = Trend.at(0.0, 0.0)
    >>> for t in range(1, 60):
    ...     trend = trend.follow(0.01 * t, 1e-4)
    >>> [round(float(x), 3) for x in trend.state], round(trend.ahead(2.0)[0], 3)
    ([0.59, 0.01], 0.61)
    """

    state: Array
    covariance: Array
    still: Array

    @classmethod
    def at(cls, level: float, variance: float) -> Self:
        """A level at rest."""
        known = np.diag([variance, 0.0])
        return cls(state=np.array([level, 0.0]), covariance=known, still=known)

    def follow(self, value: float, variance: float, elapsed: float = 1.0) -> Self:
        """After one more measurement of ``value``, so many windows after the last."""
        F = np.array([[1.0, elapsed], [0.0, 1.0]])
        x = F @ self.state
        P = F @ self.covariance @ F.T + elapsed * np.diag([LEVEL_SD**2, SLOPE_SD**2])
        gain = P[:, 0] / (P[0, 0] + variance)
        left = F - np.outer(gain, F[0])
        return type(self)(
            state=x + gain * (value - x[0]),
            covariance=P - np.outer(gain, P[0]),
            still=left @ self.still @ left.T + variance * np.outer(gain, gain),
        )

    def ahead(self, windows: float) -> tuple[float, float]:
        """The level that many windows later, and its standard deviation."""
        g = np.array([1.0, windows])
        variance = float(g @ self.covariance @ g) + (LEVEL_SD**2 + SLOPE_SD**2 * windows**2) * windows
        return float(g @ self.state), float(np.sqrt(variance))

    @property
    def slope(self) -> tuple[float, float]:
        """Slope by window and its variance."""
        return float(self.state[1]), float(self.covariance[1, 1])
