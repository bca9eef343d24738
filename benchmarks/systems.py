"""Nonlinear systems with known structure, for the input selection: one-step functions of past y and u."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.genes import Structure

Array = NDArray[np.float64]
Noise = Callable[[np.random.Generator, int], Array]
SETTLE = 200


@dataclass(frozen=True, kw_only=True)
class System:
    """``y(t) = f(y, u, t) + sd e(t)``; inputs are uniform in +-``reach``, their number is that of ``nb``."""

    name: str
    f: Callable[[Array, Array, int], float]
    sd: float
    na: int
    nb: tuple[int, ...]
    nk: tuple[int, ...]
    reach: float = 1.0

    @property
    def structure(self) -> Structure:
        names = [f"u{j + 1}" for j in range(len(self.nb))]
        return Structure(
            {"y": self.na}, dict(zip(names, self.nb, strict=True)), dict(zip(names, self.nk, strict=True))
        )

    def simulate(self, n: int, seed: int, noise: Noise | None = None) -> dict[str, Array]:
        """Columns ``y u1 u2 ..``, shape (n,)."""
        rng = np.random.default_rng([seed, 77])
        u = rng.uniform(-self.reach, self.reach, size=(n + SETTLE, len(self.nb)))
        e = self.sd * (rng.standard_normal(n + SETTLE) if noise is None else noise(rng, n + SETTLE))
        y = np.zeros(n + SETTLE)
        for t in range(10, n + SETTLE):
            y[t] = self.f(y, u, t) + e[t]
        return {"y": y[SETTLE:], **{f"u{j + 1}": u[SETTLE:, j] for j in range(u.shape[1])}}


def _narendra(y: Array, u: Array, t: int) -> float:
    a, b = y[t - 1], y[t - 2]
    return float(a * b * (a + 2.5) / (1.0 + a**2 + b**2) + u[t - 1, 0])


def _three_lags(y: Array, u: Array, t: int) -> float:
    a, b, c = y[t - 1], y[t - 2], y[t - 3]
    return float((a * b * c * u[t - 2, 0] * (c - 1.0) + u[t - 1, 0]) / (1.0 + b**2 + c**2))


def _tanh(y: Array, u: Array, t: int) -> float:
    return float(0.5 * y[t - 1] + np.tanh(2 * u[t - 7, 0]) + 0.5 * np.tanh(3 * u[t - 5, 1] * u[t - 7, 0]))


def _cubic(y: Array, u: Array, t: int) -> float:
    a, b, c = u[t - 4, 0], u[t - 1, 1], u[t - 2, 1]
    return float(0.3 * y[t - 1] + a**3 + a * b + 0.5 * c**2)


def _exponential(y: Array, u: Array, t: int) -> float:
    a, b, fade = y[t - 1], y[t - 2], np.exp(-(y[t - 1] ** 2))
    return float((0.8 - 0.5 * fade) * a - (0.3 + 0.9 * fade) * b + u[t - 2, 0])


def _waves(y: Array, u: Array, t: int) -> float:
    past = 0.6 * np.sin(2 * y[t - 1]) + 0.3 * np.cos(2 * y[t - 2])
    return float(past + u[t, 0] * np.cos(2 * u[t - 3, 1]))


SYSTEMS = (
    System(name="Narendra's rational", f=_narendra, sd=0.05, na=2, nb=(1, 0), nk=(1, 0), reach=2.0),
    System(name="Narendra's, three lags", f=_three_lags, sd=0.02, na=3, nb=(2, 0), nk=(1, 0)),
    System(name="tanh, long delays", f=_tanh, sd=0.05, na=1, nb=(1, 1), nk=(7, 5)),
    System(
        name="|u|", sd=0.05, na=1, nb=(1, 0), nk=(3, 0),
        f=lambda y, u, t: 0.5 * y[t - 1] + abs(u[t - 3, 0]),
    ),
    System(
        name="bilinear", sd=0.1, na=2, nb=(1, 1), nk=(1, 2),
        f=lambda y, u, t: 0.5 * y[t - 1] - 0.3 * y[t - 2] * u[t - 1, 0] + u[t - 2, 1],
    ),
    System(name="exponential AR", f=_exponential, sd=0.1, na=2, nb=(1, 0), nk=(2, 0)),
    System(
        name="product of two lags", sd=0.05, na=1, nb=(2, 0), nk=(2, 0),
        f=lambda y, u, t: 0.4 * y[t - 1] + u[t - 2, 0] * u[t - 3, 0],
    ),
    System(name="cubic, delayed products", f=_cubic, sd=0.05, na=1, nb=(1, 2), nk=(4, 1)),
    System(name="sine and cosine", f=_waves, sd=0.05, na=2, nb=(1, 1), nk=(0, 3)),
    System(
        name="ratio", sd=0.05, na=1, nb=(1, 1), nk=(1, 6),
        f=lambda y, u, t: 0.8 * y[t - 1] / (1 + y[t - 1] ** 2) + u[t - 1, 0] / (1 + 4 * u[t - 6, 1] ** 2),
    ),
)  # fmt: skip
