"""Tracking: the healthy indicators, how far the present ones are from them, and how a fault grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from stages.estimators import Estimate

Array = NDArray[np.float64]
LEVEL_SD, SLOPE_SD = 0.005, 0.003  # by how much a fault's logarithm may depart from its trend in a window


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Healthy logarithms of the indicators (k,), their covariance (k, k), and the spread of one window's
    where an estimator has no covariance of its own."""

    mean: Array
    covariance: Array
    spread: Array

    @classmethod
    def of(cls, windows: Sequence[Estimate]) -> Self:
        """The information-weighted mean; medians and median absolute deviations where nothing is known of the
        covariance."""
        x = np.array([e.x for e in windows])
        known = [e.covariance for e in windows if e.covariance is not None]
        if len(known) < len(windows):
            mean = np.median(x, axis=0)
            spread = np.diag((1.4826 * np.median(np.abs(x - mean), axis=0)) ** 2)
            return cls(mean=mean, covariance=spread * np.pi / 2 / len(x), spread=spread)
        information = np.linalg.inv(np.array(known))
        covariance = np.linalg.inv(information.sum(axis=0))
        mean = covariance @ np.einsum("tij,tj->i", information, x)
        return cls(mean=mean, covariance=covariance, spread=np.full_like(covariance, np.nan))

    def change(self, estimate: Estimate) -> tuple[Array, Array]:
        """``ln(indicator / healthy)`` of a window and that window's own covariance."""
        own = self.spread if estimate.covariance is None else estimate.covariance
        return estimate.x - self.mean, own


@dataclass(frozen=True, kw_only=True, eq=False)
class Average:
    """An information-weighted moving average of changes d: after each window, with forgetting g,

    ``J <- (1 - g) J + g I,  h <- (1 - g) h + g I d,  M <- (1 - g)^2 M + g^2 I``, so that M is the
    covariance of h."""

    J: Array
    h: Array
    M: Array

    @classmethod
    def empty(cls, k: int) -> Self:
        return cls(J=np.zeros((k, k)), h=np.zeros(k), M=np.zeros((k, k)))

    def add(self, d: Array, information: Array, forgetting: float) -> Self:
        g = forgetting
        return type(self)(
            J=(1.0 - g) * self.J + g * information,
            h=(1.0 - g) * self.h + g * information @ d,
            M=(1.0 - g) ** 2 * self.M + g**2 * information,
        )

    def squares(self, reference: Array) -> float:
        """How far the average is from zero, ``h' cov(h)^-1 h``: chi-squared without a change.
        ``reference``: the covariance of what all windows share."""
        covariance = self.M + self.J @ reference @ self.J
        return float(self.h @ np.linalg.pinv(covariance, rcond=1e-13, hermitian=True) @ self.h)

    def mean(self, reference: Array) -> tuple[Array, Array]:
        """The average and its covariance."""
        inverse = np.linalg.inv(self.J)
        return inverse @ self.h, inverse @ self.M @ inverse + reference


@dataclass(frozen=True, kw_only=True, eq=False)
class Trend:
    """Level and slope of a fault's size eta at a window's centre, a Kalman filter; slopes are by window."""

    state: Array
    covariance: Array

    @classmethod
    def at_rest(cls) -> Self:
        return cls(state=np.zeros(2), covariance=np.zeros((2, 2)))

    def follow(self, eta: float, variance: float) -> Self:
        """After one more window that measured ``eta``."""
        F = np.array([[1.0, 1.0], [0.0, 1.0]])
        x = F @ self.state
        P = F @ self.covariance @ F.T + np.diag([LEVEL_SD**2, SLOPE_SD**2])
        gain = P[:, 0] / (P[0, 0] + variance)
        return type(self)(state=x + gain * (eta - x[0]), covariance=P - np.outer(gain, P[0]))

    def ahead(self, windows: float) -> tuple[float, float]:
        """eta that many windows later, and its standard deviation."""
        g = np.array([1.0, windows])
        variance = float(g @ self.covariance @ g) + (LEVEL_SD**2 + SLOPE_SD**2 * windows**2) * windows
        return float(g @ self.state), float(np.sqrt(variance))
