"""Prediction-error fit of a plant and its first-order sensor, as one innovations form with structure.

The compound system of the dissertation's Figure 3.1, sampled with an input held over ``dt``:

    y = k_s / (tau s + 1) [ k_p / (s^n + a_1 s^(n-1) + ... + a_n) u + w_p ] + w_n

With ``w_n`` white and ``w_p`` (held) white or an AR(1) with pole phi, the noise is C(q) / [(q - a) (q -
phi)] e, a = exp(-dt / tau), so that the sensor's time constant acts twice: on the way from u, and as the
colour of the noise. C = q + gamma_1, or q^2 + gamma_1 q + gamma_2 with a phi, carries the share of w_n,
which (3.12) leaves out. Matching the spectra of both descriptions at the longest lag and at rest gives,
with var e = s2,

    var w_n = -gamma_1 s2 / a  or  gamma_2 s2 / (a phi),
    (k_s sd)^2 = [s2 C(1)^2 - var w_n (1 - a)^2 (1 - phi)^2] / (1 - a)^2,

sd being std(w_p) or that of its innovations. This is (3.13) repaired: a gain that neither tau nor w_n
changes. Gauss-Newton with Levenberg's damping over p = [ln tau, ln(b / a_1), ln a_1, ln(a_2 / a_1), ...,
gamma], b = k_s k_p: in these the estimates are nearly uncorrelated, where b, a_1, a_2, a_3 themselves are
99.9 % so.

Two things are estimated along, linearly: the state at the window's start, and drift inside the window, of
the output's gain, of b, and of chosen a_i. Without the latter a drifting plant looks like a slower sensor.
As drifts are hard to tell from a slow pole, they have a prior standard deviation, and so their part in the
covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ingest.physics import zero_order_hold
from stages.sensitivities import gram

Array = NDArray[np.float64]
STEPS = 12
TOLERANCE = 0.03  # of minus twice the log-likelihood: a sixth of a standard deviation before the last step
STIFF = 1e-4  # a drift that is as good as none
LEAST_LAG = 0.05  # samples
LARGEST_STEP = 2.0  # of a parameter, most of which are logarithms


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Order of the plant, sampling time ``dt`` (s), and which of a_1, a_2, ... may drift inside a window
    besides the output's gain and b.

    ``colour``: phi, the pole of the process disturbance.

    Relative drift from the window's start to its end is a priori N(0, drift_sd^2), that of b N(input_drift,
    input_drift_sd^2): it is nearly the same as another a_n, and must be known to tell them apart. Where
    nothing drifts, ``input_drift`` has the standard deviation ``input_drift_error``."""

    plant_order: int
    dt: float
    drifting: tuple[int, ...] = ()
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
        n = self.plant_order
        tau, b, a_i, gamma = unpack(p, n)
        M = gamma.size
        unit = a_i[-1] ** (-1.0 / n)  # of time, so that the plant's poles are near 1
        a_i, b, tau, dt = a_i * unit ** np.arange(1, n + 1), b * unit**n, tau / unit, self.dt / unit
        A, B = np.zeros((2 * n + 2, 2 * n + 2)), np.zeros((2 * n + 2, 1))
        for first, source in ((0, None), (n + 2, n)):
            A[np.arange(first, first + n - 1), np.arange(first + 1, first + n)] = 1.0
            A[first + n - 1, first : first + n] = -a_i[::-1]
            if source is not None:
                A[first + n - 1, source] = 1.0
        for row, source in ((n, 0), (n + 1, n)):
            A[row, [source, row]] = 1.0 / tau, -1.0 / tau
        B[n - 1] = 1.0
        Ad, Bd = zero_order_hold(A, B, dt)
        a = np.exp(-dt / tau)
        units = np.append(unit ** np.arange(n), [1.0, 1.0, 1.0])
        unrolled = (0,) * n, (0,) * M, (0,) * self._drifting.size
        G, x = gram(
            *unrolled, b * u, y, Ad, Bd[:, 0], w[: n + 3] * units, a_i, self._drifting, a, self.colour, gamma
        )
        T = np.zeros((len(G), len(G) - 1))  # from columns as simulated to columns of p
        T[[0, n + 2], 0] = 1.0, a * dt / tau
        T[1, 1:3] = 1.0
        T[2 : n + 2, 2 : n + 2] = np.tril(np.ones((n, n)))
        T[n + 3 :, n + 2 :] = np.eye(len(G) - n - 3)
        T[n + 3 + M : 2 * n + 6 + M, n + 2 + M : 2 * n + 5 + M] = np.diag(units)
        return T.T @ G @ T, x / units[: n + 1]

    @cached_property
    def expected(self) -> tuple[Array, Array]:
        """Mean and information (both vectors) of w a priori: nothing is known of the state."""
        n, drifts = self.plant_order, 2 + len(self.drifting)
        mean, information = np.zeros((2, n + 1 + drifts))
        information[n + 1 :] = self.drift_sd**-2
        mean[n + 2], information[n + 2] = self.input_drift, self.input_drift_sd**-2
        return mean, information

    def loss(self, p: Array, u: Array, y: Array) -> float:
        """Minus twice the log-likelihood of p, up to a constant."""
        mean, _ = self.expected
        G, _ = self.gram(p, mean, u, y)
        return _profile(G, p.size, self.expected[1], np.zeros_like(mean), u.size)[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A fitted window: parameters, their covariance, var e, the state after it, and what was minimised.

    ``still``: the covariance where nothing drifts, though it might: the one to judge by whether it does."""

    p: Array
    covariance: Array
    still: Array
    variance: float
    state: Array
    loss: float
    samples: int
    dt: float
    orders: int = 1  # of gamma
    colour: float = 0.0

    @cached_property
    def noise(self) -> tuple[float, float]:
        """``k_s`` times the spread of w_p, and ``std(w_n)``, in the output's unit; 0 where a square is not
        positive."""
        k2, n2 = _noise(self.p[0], self.p[-self.orders :], self.variance, self.dt, self.colour)
        return float(np.sqrt(max(k2, 0.0))), float(np.sqrt(max(n2, 0.0)))

    @cached_property
    def indicators(self) -> tuple[Array, Array, Array]:
        """Logarithms of tau, k_s times the spread of w_p, k_p = b / that, a_1 ... a_n, and to first order
        their covariance and that where nothing drifts."""
        n, M = self.p.size - 2 - self.orders, self.orders
        tau, b, a_i, _ = unpack(self.p, n)
        k = max(self.noise[0], 1e-300)
        x = np.log(np.concatenate([[tau, k, b / k], a_i]))
        z = np.concatenate([self.p[:1], self.p[-M:], [np.log(self.variance)]])

        def log_gain(z: Array) -> float:
            return 0.5 * float(
                np.log(max(_noise(z[0], z[1:-1], np.exp(z[-1]), self.dt, self.colour)[0], 1e-300))
            )

        steps = 1e-5 * np.eye(z.size)
        slope = np.array([(log_gain(z + h) - log_gain(z - h)) / 2e-5 for h in steps])
        J = np.zeros((n + 3, self.p.size + 1))  # last column: d / d ln(var e)
        J[0, 0] = 1.0
        J[1, 0], J[1, n + 2 :] = slope[0], slope[1:]
        J[2, 1:3] = 1.0
        J[2] -= J[1]
        J[3:, 2 : n + 2] = np.tril(np.ones((n, n)))
        own = 2.0 / self.samples * np.outer(J[:, -1], J[:, -1])
        J = J[:, :-1]
        return x, J @ self.covariance @ J.T + own, J @ self.still @ J.T + own


def _noise(log_tau: float, gamma: Array, variance: float, dt: float, phi: float) -> tuple[float, float]:
    """Variances ``(k_s sd)^2`` and ``var w_n`` of the description by two sources."""
    a = np.exp(-dt / np.exp(log_tau))
    measured = -gamma[0] * variance / a if gamma.size == 1 else gamma[1] * variance / (a * phi)
    at_rest = variance * (1.0 + gamma.sum()) ** 2 - measured * ((1.0 - a) * (1.0 - phi)) ** 2
    return float(at_rest / (1.0 - a) ** 2), float(measured)


def _possible(structure: Structure, p: Array) -> bool:
    """C has its zeros inside the unit circle, there is process disturbance, and the sensor lags at all."""
    gamma = p[structure.plant_order + 2 :]
    inside = abs(gamma[-1]) < 0.98 and (gamma.size == 1 or abs(gamma[0]) < 0.98 * (1.0 + gamma[1]))
    if not (inside and np.exp(p[0]) > LEAST_LAG * structure.dt):
        return False
    return _noise(p[0], gamma, 1.0, structure.dt, structure.colour)[0] > 0.0


def fit(
    structure: Structure,
    u: Array,
    y: Array,
    start: Array,
    mean: Array,
    information: Array,
    state: Array | None = None,
) -> Fit:
    """Least squares of the innovations from ``start``; ``mean`` (k,) and ``information`` (k, k) of p a
    priori.

    ``state``: that after the window before, if there is one. The covariance is computed from there: a state
    fitted to noise decays like a plant and would seem to tell of its poles where nothing excites it."""
    k, n = start.size, structure.plant_order
    expected, known = structure.expected
    fixed = n + 3  # of w, what is carried on from step to step; the rest is linear
    p, w = start, expected.copy()
    G, end = structure.gram(p, w, u, y)
    if state is None:
        w[: n + 1] += _solve(G[k:-1, k:-1], G[k:-1, -1])[: n + 1]
    else:
        w[: n + 1] = state
    G, end = structure.gram(p, w, u, y)
    v, loss = _profile(G, k, known, w - expected, u.size)
    loss += float((p - mean) @ information @ (p - mean))
    damping = 1e-3
    for _ in range(STEPS):
        H, g = G[:-1, :-1].copy(), G[:-1, -1].copy()
        H[:k, :k] += v * information
        H[np.arange(k, len(H)), np.arange(k, len(H))] += v * known
        g[:k] -= v * information @ (p - mean)
        g[k:] -= v * known * (w - expected)
        H[np.arange(k), np.arange(k)] *= 1.0 + damping
        step = _solve(H, g)
        trial, w_trial = p + step[:k], w.copy()
        w_trial[:fixed] += step[k : k + fixed]
        if np.abs(step[:k]).max() > LARGEST_STEP or not _possible(structure, trial):
            damping = max(10.0 * damping, 1e-3)
            continue
        G_trial, end_trial = structure.gram(trial, w_trial, u, y)
        v_trial, new = _profile(G_trial, k, known, w_trial - expected, u.size)
        new += float((trial - mean) @ information @ (trial - mean))
        if not new <= loss:
            damping = max(10.0 * damping, 1e-3)
            continue
        gained = loss - new
        p, w, G, end, v, loss, damping = trial, w_trial, G_trial, end_trial, v_trial, new, 0.1 * damping
        if gained < TOLERANCE:
            break
    if state is not None:
        G, _ = structure.gram(p, np.concatenate([state, w[n + 1 :]]), u, y)
    H = G[:-1, :-1] / v
    H[:k, :k] += information
    H[np.arange(k, len(H)), np.arange(k, len(H))] += known
    off = np.zeros_like(known)
    off[n + 2] = structure.input_drift_error**2
    covariance, still = _covariances(H, k, known * (1.0 - known * off))
    return Fit(
        p=p, covariance=covariance, still=still, variance=v, state=end, loss=loss, samples=u.size,
        dt=structure.dt, orders=structure.noise_order, colour=structure.colour,
    )  # fmt: skip


def _covariances(H: Array, k: int, assumed: Array) -> tuple[Array, Array]:
    """Of the first k unknowns with information matrix H: ``H^-1``, and ``H^-1 (H - D) H^-1`` with D =
    diag(0, ``assumed``), for w that is at rest. There the data's share of the information varies as ever,
    but what was known of w a priori is a mean with variance V: D = known - known V known."""
    to_w = _solve(H[k:, k:], H[k:, :k])
    covariance = np.asarray(np.linalg.inv(H[:k, :k] - H[:k, k:] @ to_w), np.float64)
    follows = to_w @ covariance
    return covariance, covariance - follows.T @ (assumed[:, None] * follows)


def _solve(M: Array, b: Array) -> Array:
    """``inv(M) b`` for a Gram matrix, its columns scaled to 1; a direction without information stays 0."""
    d = np.sqrt(np.diag(M))
    d = np.where(d > 0.0, d, 1.0)
    scaled = M / d[:, None] / d + 1e-11 * np.eye(len(M))
    x = np.linalg.solve(scaled, (b.T / d).T)
    return np.asarray((x.T / d).T)


def _profile(G: Array, k: int, known: Array, off: Array, samples: int) -> tuple[float, float]:
    """Variance of the innovations, and minus twice the log-likelihood up to a constant, with w (columns k
    to -1 of the Gram matrix) at its best; a priori it has information ``known`` and is ``off`` its mean."""
    N, Ne, ee = G[k:-1, k:-1], G[k:-1, -1], G[-1, -1]
    v = max(float(ee - Ne @ _solve(N, Ne)), 1e-300) / (samples - len(G) + 1)
    pulled = Ne - v * known * off
    left = float(ee + v * off @ (known * off) - pulled @ _solve(N + v * np.diag(known), pulled))
    return v, float(samples * np.log(max(left, 1e-300)))


def unpack(p: Array, plant_order: int) -> tuple[float, float, Array, Array]:
    """tau, b, (a_1 ... a_n), gamma of a parameter vector."""
    a_i = np.exp(np.cumsum(p[2 : plant_order + 2]))
    return float(np.exp(p[0])), float(a_i[0] * np.exp(p[1])), a_i, p[plant_order + 2 :]


def pack(tau: float, b: float, a_i: Array, gamma: Array) -> Array:
    """The inverse of :func:`unpack`."""
    ratios = np.diff(np.log(a_i), prepend=0.0)
    return np.concatenate([[np.log(tau), np.log(b / a_i[0])], ratios, gamma])
