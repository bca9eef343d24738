"""A plant and its sensor, sampled, with what a prediction-error fit needs of them.

The compound system of the dissertation's Figure 3.1, with the input held over ``dt``:

    y = k_s S(s) [ G(s) u + w_p ] + w_n,    S = 1 / (1 + tau s)  or  1 / (1 + tau s + r (tau s)^2),
    G = k_p (1 + z_1 s + ... + z_m s^m) / (s^n + a_1 s^(n-1) + ... + a_n).

A sensor of second order has two lags with sum tau, which are equal for r = 1/4; above that it oscillates.

Its parameters are p = [ln tau, ln(b / a_1), ln a_1, ln(a_2 / a_1), ..., z_i a_n^(i/n), ln r, gamma], b = k_s
k_p: in these the estimates are nearly uncorrelated, where b, a_1, a_2, a_3 themselves are 99.9 % so. There
are no z_i where the plant has no zeros, and no r where the sensor is of first order; gamma are the
coefficients of the noise (:mod:`stages.innovations`)."""

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
    """Order of the plant, the number m of its ``zeros``, that s of the sensor's lags (1 or 2), sampling time
    ``dt`` (s), and which of a_1, a_2, ... may drift inside a window besides the output's gain and b.

    ``colour``: phi, the pole of the process disturbance.

    Relative drift from the window's start to its end is a priori N(0, drift_sd^2), that of b N(input_drift,
    input_drift_sd^2): it is nearly the same as another a_n, and must be known to tell them apart. Where
    nothing drifts, ``input_drift`` has the standard deviation ``input_drift_error``."""

    plant_order: int
    dt: float
    drifting: tuple[int, ...] = ()
    zeros: int = 0
    sensor_order: int = 1
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
        return self.sensor_order + bool(self.colour)

    @property
    def held(self) -> int:
        """The number of parameters that are not gamma."""
        return self.plant_order + self.zeros + self.sensor_order + 1

    @cached_property
    def stiff(self) -> Structure:
        """Without drift: Gauss-Newton is no descent while large drifts stand in for wrong parameters."""
        return replace(self, drift_sd=STIFF, input_drift=0.0, input_drift_sd=STIFF)

    def gram(self, p: Array, w: Array, u: Array, y: Array) -> tuple[Array, Array]:
        """``V' V`` for V = [J, N, e] at parameters p, J in the order of p, and the state after the window:
        the plant's output and its derivatives, and the sensor's output (and tau times its derivative).

        N are the responses to the unknowns w beside p: the state before, and the drifts of the output's
        gain, of b, and of a_i. The last are linear only: there w is not looked at."""
        n, s, m = self.plant_order, self.sensor_order, self.zeros
        tau, b, a_i, z, r, gamma = unpack(p, n, m, s)
        M = gamma.size
        unit = a_i[-1] ** (-1.0 / n)  # of time, so that the plant's poles are near 1
        a_i, b, tau, dt = a_i * unit ** np.arange(1, n + 1), b * unit**n, tau / unit, self.dt / unit
        Ad, Bd = self._sampled(tau, r, a_i, z, dt)
        alpha, slopes = sensor_polynomial(dt / tau, r)
        units = np.append(unit ** np.arange(n), np.ones(s + 2))
        unrolled = (0,) * n, (0,) * s, (0,) * m, (0,) * M, (0,) * self._drifting.size
        G, x = gram(
            *unrolled, b * u, y, Ad, Bd[:, 0], w[: n + s + 2] * units, a_i, self._drifting, self.colour,
            coloured(alpha, self.colour), gamma,
        )  # fmt: skip
        rest, first = n + 2 + m, n + 2 + m + s - 1 + M  # of p: ln r, and the end
        pole = rest + s - 1  # the column of alpha_1; before it stands that of the second lag
        T = np.zeros((len(G), first + len(G) - pole - s - M))  # from columns as simulated to columns of p
        T[0, 0] = s
        T[pole : pole + s, 0] = slopes[0]
        if s > 1:
            T[[0, rest], rest], T[rest, 0] = 1.0, 1.0
            T[pole : pole + s, rest] = slopes[1]
        T[1, 1:3] = 1.0
        T[2 : n + 2, 2 : n + 2] = np.tril(np.ones((n, n)))
        T[n + 2 : rest, 2 : n + 2] = -(z * np.arange(1, m + 1) / n)[:, None]  # z_i is in units of a_n
        T[n + 2 : rest, n + 2 : rest] = np.eye(m)
        T[pole + s :, rest + s - 1 :] = np.eye(len(G) - pole - s)
        x0 = pole + s + M
        T[x0 : x0 + n + s + 2, first : first + n + s + 2] = np.diag(units)
        return T.T @ G @ T, x / units[: n + s]

    def _sampled(self, tau: float, r: float, a_i: Array, z: Array, dt: float) -> tuple[Array, Array]:
        """Transition and input matrix over ``dt`` of the states of :func:`stages.sensitivities.gram`."""
        n, s, m = self.plant_order, self.sensor_order, self.zeros
        size, again = 2 * (n + s) + s * m, n + s
        A, B = np.zeros((size, size)), np.zeros((size, 1))
        for first, source in ((0, None), (again + s, n)):
            A[np.arange(first, first + n - 1), np.arange(first + 1, first + n)] = 1.0
            A[first + n - 1, first : first + n] = -a_i[::-1]
            if source is not None:
                A[first + n - 1, source] = 1.0
        rate = 1.0 / tau if s == 1 else 1.0 / (r * tau)
        for first, source in [(n, 0), (again, n), *((2 * again + s * (i - 1), i) for i in range(1, m + 1))]:
            end = first + s - 1
            A[np.arange(first, end), np.arange(first + 1, end + 1)] = 1.0 / tau
            A[end, first : end + 1] = -rate
            A[end, source] = rate
        A[again - 1, 1 : m + 1] = z * rate
        B[n - 1] = 1.0
        return zero_order_hold(A, B, dt)

    @cached_property
    def expected(self) -> tuple[Array, Array]:
        """Mean and information (both vectors) of w a priori: nothing is known of the state."""
        states, drifts = self.plant_order + self.sensor_order, 2 + len(self.drifting)
        mean, information = np.zeros((2, states + drifts))
        information[states:] = self.drift_sd**-2
        mean[states + 1], information[states + 1] = self.input_drift, self.input_drift_sd**-2
        return mean, information


def unpack(
    p: Array, plant_order: int, zeros: int = 0, sensor_order: int = 1
) -> tuple[float, float, Array, Array, float, Array]:
    """tau, b, (a_1 ... a_n), (z_1 ... z_m) in units of a_n^(-i/n), r (0 for a sensor of one lag), and gamma
    of a parameter vector."""
    a_i, first = np.exp(np.cumsum(p[2 : plant_order + 2])), plant_order + 2
    last = first + zeros
    r = float(np.exp(p[last])) if sensor_order == 2 else 0.0
    b = float(a_i[0] * np.exp(p[1]))
    return float(np.exp(p[0])), b, a_i, p[first:last], r, p[last + sensor_order - 1 :]


def pack(tau: float, b: float, a_i: Array, rest: Array) -> Array:
    """The inverse of :func:`unpack`; ``rest``: z, ln r where the sensor has two lags, and gamma."""
    ratios = np.diff(np.log(a_i), prepend=0.0)
    return np.concatenate([[np.log(tau), np.log(b / a_i[0])], ratios, rest])


def sensor_polynomial(step: float, r: float) -> tuple[Array, Array]:
    """The sampled sensor's denominator ``1 + alpha_1 / q + ...``, alpha of shape (s,), and its derivatives to
    ln tau and ln r, shape (s, s). ``step`` is dt / tau, and r is 0 for a sensor of one lag.

    With two, the poles are ``exp(-h (1 ± sqrt(1 - 4 r)))``, h = dt / (2 r tau).

    >>> alpha, _ = sensor_polynomial(0.5, 0.25)  # two lags of tau / 2 each
    >>> np.allclose(np.roots([1.0, *alpha]), np.exp(-1.0), atol=1e-6)
    True
    """
    if r == 0.0:
        a = float(np.exp(-step))
        return np.array([-a]), np.array([[-a * step]])
    h, root = step / (2.0 * r), np.sqrt(complex(1.0 - 4.0 * r))
    decay, even = np.exp(-h), np.cosh(h * root).real
    odd = np.sinc(1j * h * root / np.pi).real  # sinh(x) / x
    alpha = np.array([-2.0 * decay * even, decay**2])
    by_h = np.array([2.0 * decay * (even - (1.0 - 4.0 * r) * h * odd), -2.0 * decay**2])
    by_r = np.array([4.0 * decay * h * h * odd, 0.0])  # while h stays
    return alpha, np.array([-h * by_h, -h * by_h + r * by_r])


def coloured(alpha: Array, phi: float) -> Array:
    """The coefficients behind the 1 of ``(1 + alpha_1 / q + ...) (1 - phi / q)``."""
    return np.convolve(np.append(1.0, alpha), [1.0, -phi])[1:] if phi else alpha
