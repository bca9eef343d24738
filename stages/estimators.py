"""Indicators of one window: of the corrected estimator, and of the one that the dissertation prints.

Both give ln[tau, k_s std(w_p), k_p, a_1 ... a_n], which are the indicators up to constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stages.innovations import Structure, fit
from stages.subspace import identify, lag_gram
from stages.two_rate import TwoRate

Array = NDArray[np.float64]
EstimatorName = Literal["innovations", "printed"]
FIRST_SD = 0.2  # the most that an indicator's logarithm may be in doubt for a first window to be a start


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """``x``: logarithms (n + 3,); ``covariance``, ``noise_sd`` (of the measurement): None where the
    estimator has none; ``parameters`` and ``state`` (after the window): where the next window's fit may
    start."""

    x: Array
    covariance: Array | None
    parameters: Array | None = None
    noise_sd: float | None = None
    state: Array | None = None


@dataclass(frozen=True, kw_only=True)
class Innovations:
    """The prediction-error fit of :mod:`stages.innovations`, started by :mod:`stages.two_rate`.

    From one window to the next the parameters are held near each other by a standard deviation of ``walk``,
    so that a window without excitation keeps them; its covariance says that it knows nothing.

    A product b / a_1 that moved by D from window to window drifts inside them too, and one window cannot tell
    whether at the output (the sensor's gain) or at the input (the plant's): b's drift is D / 2 +- D / 2.
    """

    structure: Structure
    start: TwoRate
    walk: float = 0.5

    def estimate(self, u: Array, y: Array, before: Sequence[Array], state: Array | None) -> Estimate | None:
        """None where the window cannot be fitted, or a first one says too little.

        ``before``: parameters of earlier windows, the last one last; ``state`` after the adjoining window.
        """
        last = before[-1] if before else None
        half = 0.5 * float(before[-1][1] - before[-2][1]) if len(before) > 1 else 0.0
        structure = replace(
            self.structure, input_drift=half, input_drift_sd=np.hypot(self.structure.input_drift_sd, half)
        )
        starts = self.start.starts(structure, u, y, last)
        if not starts:
            return None
        mean = starts[0] if last is None else last
        walk = np.diag([*[0.0 if last is None else self.walk**-2] * (mean.size - 1), 0.0])
        losses = [structure.loss(p, u, y) + (p - mean) @ walk @ (p - mean) for p in starts]
        found = fit(structure, u, y, starts[int(np.argmin(losses))], mean, walk, state)
        x, covariance = found.indicators
        if not (
            np.isfinite(x).all() and np.isfinite(covariance).all() and self._plausible(x, covariance, last)
        ):
            return None
        return Estimate(
            x=x, covariance=covariance, parameters=found.p, noise_sd=found.noise[1], state=found.state
        )

    def _plausible(self, x: Array, covariance: Array, last: Array | None) -> bool:
        """The sensor is faster than the plant, and a first window knows all parameters."""
        fastest = np.abs(np.roots([1.0, *np.exp(x[3:])])).max()
        known = last is not None or np.sqrt(np.diag(covariance).max()) < FIRST_SD
        return bool(np.exp(x[0]) * fastest < 1.0 and known)


@dataclass(frozen=True, kw_only=True)
class Printed:
    """Chapter III as printed: N4SID at the full rate, the fastest pole is the sensor, (3.13) its gain.

    ``k_s = k_k std(e)`` up to std(w_p), with k_k the pole-zero gain of C (q I - A)^-1 K, and the plant's
    gain from the static gain of C (q I - A)^-1 B, which is their product. It has no covariance."""

    structure: Structure
    horizon: int

    def estimate(self, u: Array, y: Array, before: Sequence[Array], state: Array | None) -> Estimate | None:
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
