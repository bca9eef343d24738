"""Linear models in innovations form: poles, static gains, simulation and prediction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class StateSpace:
    """The innovations form with sampling time ``dt`` (s); ``R`` is the covariance of e, shape (l, l)."""

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    R: Array
    dt: float

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """Continuous poles ``ln(eig A) / dt`` in 1/s, the slowest first."""
        eigenvalues = np.linalg.eigvals(self.A).astype(complex)
        poles = np.log(np.where(eigenvalues == 0.0, 1e-300, eigenvalues)) / self.dt
        return np.asarray(poles[np.lexsort((poles.imag, np.abs(poles)))], dtype=np.complex128)

    @property
    def gains(self) -> Array:
        """Static gain of every output to every input, shape (l, m)."""
        return np.asarray(self.C @ np.linalg.solve(np.eye(len(self.A)) - self.A, self.B) + self.D)

    @property
    def numerators(self) -> Array:
        """Coefficients of 1, s, s^2 ... s^n in the numerator of each continuous transfer function, over that
        of 1, shape (l, m, n + 1): of the system that gives this model when its inputs are held."""
        eigenvalues, V = np.linalg.eig(self.A)
        held = np.log(eigenvalues.astype(complex)) / ((eigenvalues - 1.0) * self.dt)
        poles = np.log(eigenvalues.astype(complex)) / self.dt
        residues = (self.C @ V)[:, None, :] * (np.linalg.solve(V, self.B.astype(complex)) * held[:, None]).T
        out = np.zeros((*self.D.shape, len(poles) + 1), dtype=complex)
        for j in range(len(poles)):
            out[..., 1:] += residues[..., j, None] * np.poly(np.delete(poles, j))
        out += self.D[..., None] * np.poly(poles)
        numerator = out[..., ::-1].real
        return np.asarray(numerator / numerator[..., :1], dtype=np.float64)

    def simulate(self, u: Array, x0: Array | None = None) -> Array:
        """Outputs (N, l) without noise for inputs (N, m)."""
        x = np.zeros(len(self.A)) if x0 is None else x0
        parts = (self.A, self.B, self.C, self.D, u, x)
        return np.asarray(_simulate(*(np.ascontiguousarray(part, dtype=np.float64) for part in parts)))

    def initial_state(self, y: Array, u: Array) -> Array:
        """The state (n,) from which the simulation of y (N, l) is best."""
        n = len(self.A)
        still = np.zeros((len(u), u.shape[1]))
        free = np.stack([self.simulate(still, x).ravel() for x in np.eye(n)], axis=1)
        return np.asarray(np.linalg.lstsq(free, (y - self.simulate(u)).ravel())[0])

    def predict(self, y: Array, u: Array) -> Array:
        """One-step predictions (N, l) of y (N, l) by the Kalman filter, from state 0."""
        observer = StateSpace(
            A=self.A - self.K @ self.C, B=np.hstack([self.B - self.K @ self.D, self.K]), C=self.C,
            D=np.hstack([self.D, np.zeros((len(self.C), len(self.C)))]), K=self.K, R=self.R, dt=self.dt,
        )  # fmt: skip
        return observer.simulate(np.hstack([u, y]))


@njit(cache=True)
def _simulate(
    A: Array, B: Array, C: Array, D: Array, u: Array, x0: Array
) -> Array:  # pragma: no cover - compiled
    y, x = np.empty((len(u), len(C))), x0.copy()
    for t in range(len(u)):
        y[t] = C @ x + D @ u[t]
        x = A @ x + B @ u[t]
    return y
