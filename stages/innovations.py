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

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.physics import zero_order_hold

Array = NDArray[np.float64]
STEPS = 12
TOLERANCE = 0.03  # of minus twice the log-likelihood: a sixth of a standard deviation before the last step
STIFF = 1e-4  # a drift that is as good as none
LEAST_LAG = 0.05  # samples
LARGEST_STEP = 2.0  # of a parameter, most of which are logarithms
CHUNK = 256  # samples whose columns are kept at once


@njit(cache=True, fastmath={"reassoc", "contract"})
def _add_products(columns: Array, rows: int, G: Array) -> None:  # pragma: no cover - compiled
    """Add the products of the first ``rows`` of the columns (width, rows) to the lower half of G, in
    place."""
    for i in range(len(G)):
        for j in range(i + 1):
            total = 0.0
            for t in range(rows):
                total += columns[i, t] * columns[j, t]
            G[i, j] += total


@cache
def _gram_of(n: int, M: int, D: int) -> Callable[..., tuple[Array, Array]]:
    """The compiled loop for n plant coefficients, M of the noise, D drifts: numbers that it is unrolled
    by."""
    S, first_x0 = 2 * n + 2, n + 3 + M
    first_drift = first_x0 + n + 1
    width = first_drift + D + 2

    @njit(cache=True)
    def _gram(
        u: Array,
        y: Array,
        Ad: Array,
        Bd: Array,
        x0: Array,
        scale: Array,
        drifting: NDArray[np.int64],
        a: float,
        phi: float,
        gamma: Array,
    ) -> tuple[Array, Array]:  # pragma: no cover - compiled
        """``V' V`` of the whitened columns V over a window, shape (width, width).

        Columns: sensitivities of the output to ln tau, ln b, ln a_1 ... ln a_n, those of the innovations to
        a and gamma, responses to the initial states (n + 1), to drift of the output's gain, to drifts of b
        (0) or a_i (i), and the innovations. States: plant (n), sensor, sensor again, plant again; the
        second copies make the sensitivities, as ``dy / d ln tau = y / (tau s + 1) - y`` and ``dy / d a_i =
        -s^(n-i) y / A(s)``. ``Ad`` and ``Bd`` advance them."""
        N = u.size
        G, columns = np.zeros((width, width)), np.empty((width, CHUNK))
        x, new, A, A4 = np.zeros(S), np.empty(S), Ad.T.copy(), Ad[: n + 1, : n + 1].T.copy()
        x[: n + 1] = x0
        free, free_new = np.zeros(n + 1), np.empty(n + 1)
        free[n] = 1.0
        d, d_new = np.zeros((D, n + 1)), np.empty(n + 1)
        raw, white, new_white = np.zeros(width), np.zeros(width), np.zeros(width)
        white2, before, before2 = np.zeros(width), np.zeros(width), np.zeros(width)
        c1, c2 = gamma[0], gamma[M - 1] if M > 1 else 0.0
        for t in range(N):
            when = (t - 0.5 * (N - 1)) / N
            raw[0], raw[1] = x[n + 1] - x[n], x[n]
            for i in range(n):
                raw[2 + i] = -scale[i] * x[S - 1 - i]
            raw[first_x0:first_drift] = free
            raw[first_drift] = when * x[n]
            for k in range(D):
                raw[first_drift + 1 + k] = d[k, n]
            raw[width - 1] = y[t] - x[n]
            # whitened by (q - a) (q - phi) / C; a and gamma act on that filter's own signals
            for i in range(width):
                new_white[i] = raw[i] - (a + phi) * before[i] + a * phi * before2[i]
            new_white[n + 2] = before[width - 1] - phi * before2[width - 1]
            new_white[n + 3] = white[width - 1]
            if M > 1:
                new_white[n + 2 + M] = white2[width - 1]
            for i in range(width):
                new_white[i] -= c1 * white[i] + c2 * white2[i]
                white2[i], white[i] = white[i], new_white[i]
                before2[i], before[i] = before[i], raw[i]
            columns[:, t % CHUNK] = white
            if t % CHUNK == CHUNK - 1 or t == N - 1:
                _add_products(columns, t % CHUNK + 1, G)
            for i in range(S):
                new[i] = Bd[i] * u[t]
            for j in range(S):
                for i in range(S):
                    new[i] += A[j, i] * x[j]
            for k in range(D):
                i = drifting[k] - 1
                w = u[t] * when if i < 0 else -scale[i] * when * 0.5 * (x[n - 1 - i] + new[n - 1 - i])
                for row in range(n + 1):
                    d_new[row] = Bd[row] * w
                for j in range(n + 1):
                    for row in range(n + 1):
                        d_new[row] += A4[j, row] * d[k, j]
                d[k] = d_new
            x[:] = new
            free_new[:] = 0.0
            for i in range(n + 1):
                for j in range(n + 1):
                    free_new[j] += free[i] * Ad[i, j]
            free[:] = free_new
        for i in range(width):
            G[:i, i] = G[i, :i]
        return G, x[: n + 1].copy()

    return _gram


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Order of the plant, sampling time ``dt`` (s), and which of a_1, a_2, ... may drift inside a window
    besides the output's gain and b.

    ``colour``: phi, the pole of the process disturbance.

    Relative drift from the window's start to its end is a priori N(0, drift_sd^2), that of b N(input_drift,
    input_drift_sd^2): it is nearly the same as another a_n, and must be known to tell them apart."""

    plant_order: int
    dt: float
    drifting: tuple[int, ...] = ()
    colour: float = 0.0
    drift_sd: float = 0.05
    input_drift: float = 0.0
    input_drift_sd: float = 0.002

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

    def gram(self, p: Array, x0: Array, u: Array, y: Array) -> tuple[Array, Array]:
        """``V' V`` for V = [J, N, e] at parameters p, J in the order of p, N the linear unknowns; and the
        state after the window that x0 leads to: the plant's output and its derivatives, and the sensor's
        output."""
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
        units = np.append(unit ** np.arange(n), 1.0)
        loop = _gram_of(n, M, self._drifting.size)
        G, x = loop(b * u, y, Ad, Bd[:, 0], x0 * units, a_i, self._drifting, a, self.colour, gamma)
        T = np.zeros((len(G), len(G) - 1))  # from columns as simulated to columns of p
        T[[0, n + 2], 0] = 1.0, a * dt / tau
        T[1, 1:3] = 1.0
        T[2 : n + 2, 2 : n + 2] = np.tril(np.ones((n, n)))
        T[n + 3 :, n + 2 :] = np.eye(len(G) - n - 3)
        T[n + 3 + M : 2 * n + 4 + M, n + 2 + M : 2 * n + 3 + M] = np.diag(units)
        T[2 * n + 5 + M, -1] = -self.input_drift  # innovations beyond the drift of b that is expected
        return T.T @ G @ T, x / units

    def information(self, parameters: Array) -> Array:
        """What is known of [p, linear unknowns] a priori: ``parameters`` (k, k) of p, nothing of the
        state."""
        n, k, drifts = self.plant_order, len(parameters), 2 + len(self.drifting)
        known = np.zeros((k + n + 1 + drifts,) * 2)
        known[:k, :k] = parameters
        known[k + n + 1 :, k + n + 1 :] = np.eye(drifts) / self.drift_sd**2
        known[k + n + 2, k + n + 2] = self.input_drift_sd**-2
        return known

    def loss(self, p: Array, u: Array, y: Array) -> float:
        """Minus twice the log-likelihood of p, up to a constant."""
        k = p.size
        G, _ = self.gram(p, np.zeros(self.plant_order + 1), u, y)
        return _profile(G, k, self.information(np.zeros((k, k))), u.size)[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A fitted window: parameters, their covariance, var e, the state after it, and what was minimised."""

    p: Array
    covariance: Array
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
    def indicators(self) -> tuple[Array, Array]:
        """Logarithms of tau, k_s times the spread of w_p, k_p = b / that, a_1 ... a_n, and their covariance
        to first order."""
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
        P = np.zeros((self.p.size + 1,) * 2)
        P[:-1, :-1], P[-1, -1] = self.covariance, 2.0 / self.samples
        return x, J @ P @ J.T


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
    k, known = start.size, structure.information(information)
    p, x0 = start, np.zeros(structure.plant_order + 1) if state is None else state
    G, end = structure.gram(p, x0, u, y)
    if state is None:
        x0 = x0 + _solve(G[k:-1, k:-1], G[k:-1, -1])[: x0.size]
        G, end = structure.gram(p, x0, u, y)
    v, loss = _profile(G, k, known, u.size)
    loss += float((p - mean) @ information @ (p - mean))
    damping = 1e-3
    for _ in range(STEPS):
        H, g = G[:-1, :-1] + v * known, G[:-1, -1].copy()
        g[:k] -= v * information @ (p - mean)
        H[np.arange(k), np.arange(k)] *= 1.0 + damping
        step = _solve(H, g)
        trial, x0_trial = p + step[:k], x0 + step[k : k + x0.size]
        if np.abs(step[:k]).max() > LARGEST_STEP or not _possible(structure, trial):
            damping = max(10.0 * damping, 1e-3)
            continue
        G_trial, end_trial = structure.gram(trial, x0_trial, u, y)
        v_trial, new = _profile(G_trial, k, known, u.size)
        new += float((trial - mean) @ information @ (trial - mean))
        if not new <= loss:
            damping = max(10.0 * damping, 1e-3)
            continue
        gained = loss - new
        p, x0, G, end, v, loss, damping = trial, x0_trial, G_trial, end_trial, v_trial, new, 0.1 * damping
        if gained < TOLERANCE:
            break
    if state is not None:
        G, _ = structure.gram(p, state, u, y)
    H = G[:-1, :-1] / v + known
    covariance = np.asarray(np.linalg.inv(H[:k, :k] - H[:k, k:] @ _solve(H[k:, k:], H[k:, :k])), np.float64)
    return Fit(
        p=p, covariance=covariance, variance=v, state=end, loss=loss, samples=u.size, dt=structure.dt,
        orders=structure.noise_order, colour=structure.colour,
    )  # fmt: skip


def _solve(M: Array, b: Array) -> Array:
    """``inv(M) b`` for a Gram matrix, its columns scaled to 1; a direction without information stays 0."""
    d = np.sqrt(np.diag(M))
    d = np.where(d > 0.0, d, 1.0)
    scaled = M / d[:, None] / d + 1e-11 * np.eye(len(M))
    x = np.linalg.solve(scaled, (b.T / d).T)
    return np.asarray((x.T / d).T)


def _profile(G: Array, k: int, known: Array, samples: int) -> tuple[float, float]:
    """Variance of the innovations, and minus twice the log-likelihood up to a constant, with the linear
    unknowns (columns k to -1 of the Gram matrix, a priori ``known``) at their best."""
    N, Ne, ee = G[k:-1, k:-1], G[k:-1, -1], G[-1, -1]
    v = max(float(ee - Ne @ _solve(N, Ne)), 1e-300) / (samples - len(G) + 1)
    left = max(float(ee - Ne @ _solve(N + v * known[k:, k:], Ne)), 1e-300)
    return v, float(samples * np.log(left))


def unpack(p: Array, plant_order: int) -> tuple[float, float, Array, Array]:
    """tau, b, (a_1 ... a_n), gamma of a parameter vector."""
    a_i = np.exp(np.cumsum(p[2 : plant_order + 2]))
    return float(np.exp(p[0])), float(a_i[0] * np.exp(p[1])), a_i, p[plant_order + 2 :]


def pack(tau: float, b: float, a_i: Array, gamma: Array) -> Array:
    """The inverse of :func:`unpack`."""
    ratios = np.diff(np.log(a_i), prepend=0.0)
    return np.concatenate([[np.log(tau), np.log(b / a_i[0])], ratios, gamma])
