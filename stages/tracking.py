"""Tracking: the healthy indicators, and how far the present ones are from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from stages.estimators import Estimate

Array = NDArray[np.float64]


FAR, FAR_SD = (
    1e-9,
    0.02,
)  # a window that is less probable than FAR, given what a median may be off, is an outlier


def _squares(d: Array, covariance: Array) -> float:
    return float(d @ np.linalg.solve(covariance, d))


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Healthy logarithms of the indicators (k,), their covariance (k, k), and the spread of one window's
    where an estimator has no covariance of its own."""

    mean: Array
    covariance: Array
    spread: Array

    @classmethod
    def of(cls, windows: Sequence[Estimate], share: float = 1.0) -> Self:
        """The information-weighted mean of all windows but outliers; medians and median absolute deviations
        where nothing is known of the covariance. ``share``: of a window's samples, those that count for it
        alone."""
        x = np.array([e.x for e in windows])
        known = [e.covariance for e in windows if e.covariance is not None]
        if len(known) < len(windows):
            mean = np.median(x, axis=0)
            spread = np.diag((1.4826 * np.median(np.abs(x - mean), axis=0)) ** 2)
            return cls(mean=mean, covariance=spread * np.pi / 2 / (share * len(x)), spread=spread)
        P, middle = np.array(known), np.median(x, axis=0)
        doubt = P + FAR_SD**2 * np.eye(len(middle))
        apart = np.array([_squares(d, S) for d, S in zip(x - middle, doubt, strict=True)])
        inside = apart <= max(chdtri(x.shape[1], FAR), float(np.median(apart)))
        information = share * np.linalg.inv(P[inside])
        covariance = np.linalg.inv(information.sum(axis=0))
        mean = covariance @ np.einsum("tij,tj->i", information, x[inside])
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
