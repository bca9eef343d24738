"""A plant and its first-order sensor, sampled, with what a prediction-error fit needs of them.

The compound system of the dissertation's Figure 3.1, with the input held over ``dt``:

    y = k_s / (tau s + 1) [ G(s) u + w_p ] + w_n,
    G = k_p (1 + z_1 s + ... + z_m s^m) / (s^n + a_1 s^(n-1) + ... + a_n).

Its parameters are p = [ln tau, ln(b / a_1), ln a_1, ln(a_2 / a_1), ..., z_i a_n^(i/n), gamma], b = k_s k_p:
in these the estimates are nearly uncorrelated, where b, a_1, a_2, a_3 themselves are 99.9 % so. The z_i are
0 where the plant has no zeros; gamma are the coefficients of the noise (:mod:`stages.innovations`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ingest.physics import zero_order_hold
from stages.sensitivities import gram

Array = NDArray[np.float64]
STIFF = 1e-4  # a drift that is as good as none


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Order of the plant, the number m of its ``zeros``, sampling time ``dt`` (s), and which of a_1, a_2, ...
    may drift inside a window besides the output's gain and b.

    ``colour``: phi, the pole of the process disturbance.

    Relative drift from the window's start to its end is a priori N(0, drift_sd^2), that of b N(input_drift,
    input_drift_sd^2): it is nearly the same as another a_n, and must be known to tell them apart. Where
    nothing drifts, ``input_drift`` has the standard deviation ``input_drift_error``."""

    plant_order: int
    dt: float
    drifting: tuple[int, ...] = ()
    zeros: int = 0
    colour: float = 0.0
    drift_sd: float = 0.05
    input_drift: float = 0.0
    input_drift_sd: float = 0.002
    input_drift_error: float = 0.0

    @cached_property
    def _drifting(self) -> NDArray[np.int64]:
        return np.array([0, *self.drifting], dtype=np.int64)  # 0: b

    @property
    def noise_order(self) -> int:
        """M, the number of gamma."""
        return 2 if self.colour else 1

    @cached_property
    def stiff(self) -> Structure:
        """Without drift: Gauss-Newton is no descent while large drifts stand in for wrong parameters."""
        return replace(self, drift_sd=STIFF, input_drift=0.0, input_drift_sd=STIFF)

    def gram(self, p: Array, w: Array, u: Array, y: Array) -> tuple[Array, Array]:
        """``V' V`` for V = [J, N, e] at parameters p, J in the order of p, and the state after the window:
        the plant's output and its derivatives, and the sensor's output.

        N are the responses to the unknowns w beside p: the state before, and the drifts of the output's
        gain, of b, and of a_i. The last are linear only: there w is not looked at."""
        n, m = self.plant_order, self.zeros
        tau, b, a_i, z, gamma = unpack(p, n, m)
        M = gamma.size
        unit = a_i[-1] ** (-1.0 / n)  # of time, so that the plant's poles are near 1
        a_i, b, tau, dt = a_i * unit ** np.arange(1, n + 1), b * unit**n, tau / unit, self.dt / unit
        Ad, Bd = self._sampled(tau, a_i, z, dt)
        a = np.exp(-dt / tau)
        units = np.append(unit ** np.arange(n), [1.0, 1.0, 1.0])
        unrolled = (0,) * n, (0,) * m, (0,) * M, (0,) * self._drifting.size
        G, x = gram(
            *unrolled, b * u, y, Ad, Bd[:, 0], w[: n + 3] * units, a_i, self._drifting, a, self.colour, gamma
        )
        pole = n + m + 2  # the column of a; before it stand those of z, behind it those of gamma
        T = np.zeros((len(G), len(G) - 1))  # from columns as simulated to columns of p
        T[[0, pole], 0] = 1.0, a * dt / tau
        T[1, 1:3] = 1.0
        T[2 : n + 2, 2 : n + 2] = np.tril(np.ones((n, n)))
        T[n + 2 : pole, 2 : n + 2] = -(z * np.arange(1, m + 1) / n)[:, None]  # z_i is in units of a_n
        T[n + 2 : pole, n + 2 : pole] = np.eye(m)
        T[pole + 1 :, pole:] = np.eye(len(G) - pole - 1)
        first = pole + M
        T[first + 1 : first + n + 4, first : first + n + 3] = np.diag(units)
        return T.T @ G @ T, x / units[: n + 1]

    def _sampled(self, tau: float, a_i: Array, z: Array, dt: float) -> tuple[Array, Array]:
        """Transition and input matrix over ``dt`` of the states of :func:`stages.sensitivities.gram`."""
        n, m = self.plant_order, self.zeros
        A, B = np.zeros((2 * n + 2 + m, 2 * n + 2 + m)), np.zeros((2 * n + 2 + m, 1))
        for first, source in ((0, None), (n + 2, n)):
            A[np.arange(first, first + n - 1), np.arange(first + 1, first + n)] = 1.0
            A[first + n - 1, first : first + n] = -a_i[::-1]
            if source is not None:
                A[first + n - 1, source] = 1.0
        lags = [(n, 0), (n + 1, n), *((2 * n + 1 + i, i) for i in range(1, m + 1))]
        for row, source in lags:
            A[row, [source, row]] = 1.0 / tau, -1.0 / tau
        A[n, 1 : m + 1] = z / tau
        B[n - 1] = 1.0
        return zero_order_hold(A, B, dt)

    @cached_property
    def expected(self) -> tuple[Array, Array]:
        """Mean and information (both vectors) of w a priori: nothing is known of the state."""
        n, drifts = self.plant_order, 2 + len(self.drifting)
        mean, information = np.zeros((2, n + 1 + drifts))
        information[n + 1 :] = self.drift_sd**-2
        mean[n + 2], information[n + 2] = self.input_drift, self.input_drift_sd**-2
        return mean, information


def unpack(p: Array, plant_order: int, zeros: int = 0) -> tuple[float, float, Array, Array, Array]:
    """tau, b, (a_1 ... a_n), (z_1 ... z_m) in units of a_n^(-i/n), and gamma of a parameter vector."""
    a_i, first = np.exp(np.cumsum(p[2 : plant_order + 2])), plant_order + 2
    return (
        float(np.exp(p[0])),
        float(a_i[0] * np.exp(p[1])),
        a_i,
        p[first : first + zeros],
        p[first + zeros :],
    )


def pack(tau: float, b: float, a_i: Array, rest: Array) -> Array:
    """The inverse of :func:`unpack`; ``rest``: z and gamma."""
    ratios = np.diff(np.log(a_i), prepend=0.0)
    return np.concatenate([[np.log(tau), np.log(b / a_i[0])], ratios, rest])
