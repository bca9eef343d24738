"""Prediction-error fit of a plant and its sensor, as one innovations form with structure.

With ``w_n`` of :mod:`stages.structure` white and ``w_p`` (held) white or an AR(1) with pole phi, the noise is
C(q) / A(q) e, A = 1 + alpha_1 / q + ... + alpha_M / q^M with the sensor's poles and phi, so that the sensor's
time constant acts twice: on the way from u, and as the colour of the noise. C = 1 + gamma_1 / q + ... +
gamma_M / q^M carries the share of w_n, which (3.12) leaves out. For a first-order sensor and white w_p, A =
1 - a / q, a = exp(-dt / tau). Matching the spectra of both descriptions at the longest lag and at rest gives,
with var e = s2 and A_s of the sensor alone,

    var w_n = gamma_M s2 / alpha_M,        (k_s sd)^2 = [s2 C(1)^2 - var w_n A(1)^2] / A_s(1)^2,

sd being std(w_p) or that of its innovations. This is (3.13) repaired: a gain that neither tau nor w_n
changes. Gauss-Newton with Levenberg's damping over the structure's p.

Two things are estimated along, linearly: the state at the window's start, and drift inside the window, of
the output's gain, of b, and of chosen a_i. Without the latter a drifting plant looks like a slower sensor.
As drifts are hard to tell from a slow pole, they have a prior standard deviation, and so their part in the
covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stages.structure import Structure, coloured, sensor_polynomial, unpack

Array = NDArray[np.float64]
STEPS = 12
TOLERANCE = 0.03  # of minus twice the log-likelihood: a sixth of a standard deviation before the last step
LEAST_LAG = 0.05  # samples
INSIDE = 0.98  # where the zeros of C may be
LARGEST_STEP = 2.0  # of a parameter, most of which are logarithms


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
    plant_order: int
    zeros: int = 0
    sensor_order: int = 1
    colour: float = 0.0

    @cached_property
    def noise(self) -> tuple[float, float]:
        """``k_s`` times the spread of w_p, and ``std(w_n)``, in the output's unit; 0 where a square is not
        positive."""
        k2, n2 = self._noise(np.append(self.p, np.log(self.variance)))
        return float(np.sqrt(max(k2, 0.0))), float(np.sqrt(max(n2, 0.0)))

    def _noise(self, z: Array) -> tuple[float, float]:
        """The variances at other parameters and ln(var e)."""
        tau, *_, r, gamma = unpack(z[:-1], self.plant_order, self.zeros, self.sensor_order)
        return noise_of(tau, r, gamma, float(np.exp(z[-1])), self.dt, self.colour)

    @cached_property
    def indicators(self) -> tuple[Array, Array, Array]:
        """Logarithms of tau, k_s times the spread of w_p, k_p = b / that, a_1 ... a_n, and to first order
        their covariance and that where nothing drifts."""
        n = self.plant_order
        tau, b, a_i, *_ = unpack(self.p, n, self.zeros, self.sensor_order)
        k = max(self.noise[0], 1e-300)
        x = np.log(np.concatenate([[tau, k, b / k], a_i]))
        z = np.append(self.p, np.log(self.variance))

        def log_gain(z: Array) -> float:
            return 0.5 * float(np.log(max(self._noise(z)[0], 1e-300)))

        J = np.zeros((n + 3, z.size))  # last column: d / d ln(var e)
        J[0, 0] = 1.0
        for i in (0, *range(n + 2 + self.zeros, z.size)):  # neither b, a_i nor z
            h = 1e-5 * np.eye(z.size)[i]
            J[1, i] = (log_gain(z + h) - log_gain(z - h)) / 2e-5
        J[2, 1:3] = 1.0
        J[2] -= J[1]
        J[3:, 2 : n + 2] = np.tril(np.ones((n, n)))
        own = 2.0 / self.samples * np.outer(J[:, -1], J[:, -1])
        J = J[:, :-1]
        return x, J @ self.covariance @ J.T + own, J @ self.still @ J.T + own


def noise_of(
    tau: float, r: float, gamma: Array, variance: float, dt: float, colour: float
) -> tuple[float, float]:
    """Variances ``(k_s sd)^2`` and ``var w_n`` of the description by two sources."""
    alone, _ = sensor_polynomial(dt / tau, r)
    alpha = coloured(alone, colour)
    measured = gamma[-1] * variance / alpha[-1]
    at_rest = variance * (1.0 + gamma.sum()) ** 2 - measured * (1.0 + alpha.sum()) ** 2
    return float(at_rest / (1.0 + alone.sum()) ** 2), float(measured)


def _possible(structure: Structure, p: Array) -> bool:
    """C has its zeros inside the unit circle, there is process disturbance, and the sensor lags at all."""
    tau, *_, r, gamma = unpack(p, structure.plant_order, structure.zeros, structure.sensor_order)
    if not (np.abs(np.roots([1.0, *gamma])).max(initial=0.0) < INSIDE and tau > LEAST_LAG * structure.dt):
        return False
    return noise_of(tau, r, gamma, 1.0, structure.dt, structure.colour)[0] > 0.0


def loss(structure: Structure, p: Array, u: Array, y: Array) -> float:
    """Minus twice the log-likelihood of p, up to a constant."""
    mean, known = structure.expected
    G, _ = structure.gram(p, mean, u, y)
    return _profile(G, p.size, known, np.zeros_like(mean), u.size)[1]


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
    k, states = start.size, structure.plant_order + structure.sensor_order
    expected, known = structure.expected
    fixed = states + 2  # of w, what is carried on from step to step; the rest is linear
    p, w = start, expected.copy()
    if state is None:
        G, _ = structure.gram(p, w, u, y)
        w[:states] += _solve(G[k:-1, k:-1], G[k:-1, -1])[:states]
    else:
        w[:states] = state
    G, end = structure.gram(p, w, u, y)
    v, now = _profile(G, k, known, w - expected, u.size)
    now += float((p - mean) @ information @ (p - mean))
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
        if not new <= now:
            damping = max(10.0 * damping, 1e-3)
            continue
        gained = now - new
        p, w, G, end, v, now, damping = trial, w_trial, G_trial, end_trial, v_trial, new, 0.1 * damping
        if gained < TOLERANCE:
            break
    if state is not None:
        G, _ = structure.gram(p, np.concatenate([state, w[states:]]), u, y)
    H = G[:-1, :-1] / v
    H[:k, :k] += information
    H[np.arange(k, len(H)), np.arange(k, len(H))] += known
    off = np.zeros_like(known)
    off[states + 1] = structure.input_drift_error**2
    covariance, still = _covariances(H, k, known * (1.0 - known * off))
    return Fit(
        p=p, covariance=covariance, still=still, variance=v, state=end, loss=now, samples=u.size,
        dt=structure.dt, plant_order=structure.plant_order, zeros=structure.zeros,
        sensor_order=structure.sensor_order, colour=structure.colour,
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
