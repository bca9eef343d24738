"""Indicators of one window: of the corrected estimator, and of the one that the dissertation prints.

Both give ln[tau, k_s std(w_p), k_p, a_1 ... a_n], which are the indicators up to constants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stages.innovations import Fit, Structure, fit
from stages.subspace import identify, lag_gram
from stages.trend import Trend
from stages.two_rate import TwoRate

Array = NDArray[np.float64]
EstimatorName = Literal["innovations", "printed"]
FIRST_SD = 0.2  # the most that an indicator's logarithm may be in doubt for a first window to be a start


@dataclass(frozen=True, kw_only=True, eq=False)
class Memory:
    """What a window leaves to the next: its parameters, the state after it, and the trends of ``ln k_s``
    and of ``ln(b / a_1)``."""

    parameters: Array
    state: Array
    gain: Trend
    product: Trend


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """``x``: logarithms (n + 3,); ``covariance``, ``noise_sd`` (of the measurement), ``memory``: None where
    the estimator has none."""

    x: Array
    covariance: Array | None
    noise_sd: float | None = None
    memory: Memory | None = None


@dataclass(frozen=True, kw_only=True)
class Innovations:
    """The prediction-error fit of :mod:`stages.innovations`, started by :mod:`stages.two_rate`.

    From one window to the next the parameters are held near each other by a standard deviation of ``walk``,
    so that a window without excitation keeps them; its covariance says that it knows nothing.

    One window cannot tell whether b drifts at the output (the sensor's gain) or at the input (the plant's).
    Over several windows the trend of ``ln k_s`` is that of the sensor, the rest of the trend of b is the
    plant's."""

    structure: Structure
    start: TwoRate
    walk: float = 0.5

    def estimate(self, u: Array, y: Array, memory: Memory | None, adjoins: bool) -> Estimate | None:
        """None where the window cannot be fitted, or a first one says too little; ``adjoins``: the window
        begins where the one that is remembered ended."""
        structure, last = self._drifting(memory), None if memory is None else memory.parameters
        starts = self.start.starts(structure, u, y, last)
        state = memory.state if memory is not None and adjoins else None
        fits: list[Fit] = []
        if last is None:
            walk = np.zeros((self.structure.plant_order + 3,) * 2)
        else:
            walk = np.diag([*[self.walk**-2] * (last.size - 1), 0.0])
            fits.append(fit(structure, u, y, last, last, walk, state))
            starts = [p for p in starts if structure.loss(p, u, y) + _squared(p - last, walk) < fits[0].loss]
        for p in starts:
            mean = p if last is None else last
            near = fit(structure.stiff, u, y, p, mean, walk, state).p
            fits.append(fit(structure, u, y, near, mean, walk, state))
        if not fits:
            return None
        found = min(fits, key=lambda f: f.loss)
        x, covariance = found.indicators
        known = np.isfinite(x).all() and np.isfinite(covariance).all()
        if not (known and self._plausible(x, covariance, last)):
            return None
        return Estimate(x=x, covariance=covariance, noise_sd=found.noise[1], memory=_remember(memory, found))

    def _drifting(self, memory: Memory | None) -> Structure:
        """The structure, with the drift of b inside the window that is expected."""
        if memory is None:
            return self.structure
        (product, product_v), (gain, gain_v) = memory.product.slope, memory.gain.slope
        sd = np.sqrt(self.structure.input_drift_sd**2 + product_v + gain_v)
        return replace(self.structure, input_drift=product - gain, input_drift_sd=float(sd))

    def _plausible(self, x: Array, covariance: Array, last: Array | None) -> bool:
        """The sensor is faster than the plant, and a first window knows all parameters."""
        fastest = np.abs(np.roots([1.0, *np.exp(x[3:])])).max()
        known = last is not None or np.sqrt(np.diag(covariance).max()) < FIRST_SD
        return bool(np.exp(x[0]) * fastest < 1.0 and known)


def _squared(x: Array, information: Array) -> float:
    return float(x @ information @ x)


def _remember(memory: Memory | None, found: Fit) -> Memory:
    x, covariance = found.indicators
    measured = (x[1], covariance[1, 1]), (found.p[1], found.covariance[1, 1])
    if memory is None:
        gain, product = (Trend.at(float(value), float(v)) for value, v in measured)
    else:
        trends = memory.gain, memory.product
        gain, product = (
            t.follow(float(value), float(v)) for t, (value, v) in zip(trends, measured, strict=True)
        )
    return Memory(parameters=found.p, state=found.state, gain=gain, product=product)


@dataclass(frozen=True, kw_only=True)
class Printed:
    """Chapter III as printed: N4SID at the full rate, the fastest pole is the sensor, (3.13) its gain.

    ``k_s = k_k std(e)`` up to std(w_p), with k_k the pole-zero gain of C (q I - A)^-1 K, and the plant's
    gain from the static gain of C (q I - A)^-1 B, which is their product. It has no covariance."""

    structure: Structure
    horizon: int

    def estimate(self, u: Array, y: Array, memory: Memory | None, adjoins: bool) -> Estimate | None:
        """None where N4SID finds no stable model of the order."""
        n = self.structure.plant_order
        try:
            gram = lag_gram(y[:, None], u[:, None], self.horizon)
            model = identify(gram, self.structure.dt, order=n + 1, method="n4sid").model
        except np.linalg.LinAlgError:
            return None
        rates = -model.poles.real
        k_s = abs((model.C @ model.K).item()) * np.sqrt(model.R.item())
        a_i = np.real(np.poly(model.poles[:-1]))[1:]
        b = abs(model.gains.item()) * a_i[-1]
        values = np.concatenate([[1.0 / rates[-1], k_s, b / k_s], a_i])
        if not (np.isfinite(values).all() and (values > 0.0).all() and (rates > 0.0).all()):
            return None
        return Estimate(x=np.log(values), covariance=None)
