"""Indicators of one window: of the corrected estimator, and of the one that the dissertation prints.

Both give ln[tau, k_s std(w_p), k_p, a_1 ... a_n], which are the indicators up to constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stages.innovations import Fit, fit, loss
from stages.structure import Structure
from stages.subspace import identify, lag_gram
from stages.trend import Trend
from stages.two_rate import TwoRate

Array = NDArray[np.float64]
EstimatorName = Literal["innovations", "printed"]
TRIED_COLOUR = 0.8
CLEAR = 40.0  # of minus twice the log-likelihood: coloured noise must earn its two parameters
JUMP = 3.0  # of its standard deviation, of ln tau from one window to the next
SPLIT_SD = 0.3  # how well the trends divide a drift of b, as a share of it
FIRST_SD = 0.2  # the most that an indicator's logarithm may be in doubt for a first window to be a start


@dataclass(frozen=True, kw_only=True, eq=False)
class Memory:
    """What a window leaves to the next: its parameters, the trends of ``ln k_s`` and of ``ln(b / a_1)``, and
    the colour of the disturbance."""

    parameters: Array
    gain: Trend
    product: Trend
    colour: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """``x``: logarithms (n + 3,); ``covariance``, ``still`` (that where nothing drifts), ``noise_sd`` (of the
    measurement), ``memory``, and ``state`` after the window: None where the estimator has none."""

    x: Array
    covariance: Array | None
    still: Array | None = None
    noise_sd: float | None = None
    memory: Memory | None = None
    state: Array | None = None


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
    walk: float = 0.2
    share: float = 1.0  # of a window, that the one before does not have

    def estimate(self, u: Array, y: Array, memory: Memory | None, state: Array | None) -> Estimate | None:
        """None where the window cannot be fitted, or a first one says too little; ``state``: that after an
        earlier window that ended where this one begins, if there was one."""
        structure = self._drifting(memory)
        found = self._first(u, y) if memory is None else self._next(structure, u, y, memory, state)
        if found is None:
            return None
        x, covariance, still = found.indicators
        known = np.isfinite(x).all() and np.isfinite(covariance).all()
        if not (known and self._plausible(x, covariance, memory)):
            return None
        return Estimate(
            x=x, covariance=covariance, still=still, noise_sd=found.noise[1],
            memory=self._remember(memory, found), state=found.state,
        )  # fmt: skip

    def _first(self, u: Array, y: Array) -> Fit | None:
        """With white disturbance, or with the coloured one that predicts clearly better. Before that is
        believed, the white one is tried again from there: it may have ended in a wrong minimum."""
        coloured_too = replace(self.structure, colour=TRIED_COLOUR)
        white, coloured = (
            self._best(s, self.start.starts(s, u, y, None), u, y) for s in (self.structure, coloured_too)
        )
        if white is None or coloured is None or white.loss < coloured.loss + CLEAR:
            return white
        start = np.append(coloured.p[: self.structure.held], np.zeros(self.structure.noise_order))
        again = self._best(self.structure, [start], u, y)
        if again is not None and again.loss < coloured.loss + CLEAR:
            return again
        return self._coloured(u, y, coloured)

    def _coloured(self, u: Array, y: Array, start: Fit) -> Fit:
        """The pole phi of the disturbance by golden sections of its time constant's logarithm."""
        from scipy.optimize import minimize_scalar

        dt, none = self.structure.dt, np.zeros((start.p.size,) * 2)

        def at(log_tau: float) -> Fit:
            colour = float(np.exp(-dt / np.exp(log_tau)))
            return fit(replace(self.structure, colour=colour), u, y, start.p, start.p, none)

        bounds = np.log([dt, 100.0 * dt])
        best = minimize_scalar(lambda v: at(v).loss, bounds=bounds, method="bounded", options={"maxiter": 12})
        return at(best.x)

    def _best(self, structure: Structure, starts: Sequence[Array], u: Array, y: Array) -> Fit | None:
        """The best of the fits from all starts, those without drift first."""
        fits = []
        for p in starts:
            none = np.zeros((p.size, p.size))
            near = fit(structure.stiff, u, y, p, p, none).p
            fits.append(fit(structure, u, y, near, near, none))
        return min(fits, key=lambda f: f.loss, default=None)

    def _next(self, structure: Structure, u: Array, y: Array, memory: Memory, state: Array | None) -> Fit:
        """From the last window's parameters; and anew, where the subspace model predicts better than that, or
        where tau has jumped: then that may be a wrong minimum."""
        last = memory.parameters
        held = np.zeros(last.size)
        held[: structure.held] = self.walk**-2
        fits = [fit(structure, u, y, last, last, np.diag(held), state)]
        jumped = abs(fits[0].p[0] - last[0]) > JUMP * np.sqrt(fits[0].covariance[0, 0])
        for p in self.start.starts(structure, u, y, last):
            if jumped or loss(structure, p, u, y) + (p - last) @ (held * (p - last)) < fits[0].loss:
                near = fit(structure.stiff, u, y, p, last, np.diag(held), state).p
                fits.append(fit(structure, u, y, near, last, np.diag(held), state))
        return min(fits, key=lambda f: f.loss)

    def _drifting(self, memory: Memory | None) -> Structure:
        """The structure, with the drift of b inside the window that is expected."""
        if memory is None:
            return self.structure
        (product, product_v), (gain, gain_v) = memory.product.slope, memory.gain.slope
        doubt = self.structure.input_drift_sd**2 + product_v + gain_v + (SPLIT_SD * product) ** 2
        return replace(
            self.structure,
            colour=memory.colour,
            input_drift=product - gain,
            input_drift_sd=float(np.sqrt(doubt)),
            input_drift_error=float(np.sqrt(memory.product.still[1, 1] + memory.gain.still[1, 1])),
        )

    def _plausible(self, x: Array, covariance: Array, memory: Memory | None) -> bool:
        """The sensor is faster than the plant, and a first window knows all parameters."""
        fastest = np.abs(np.roots([1.0, *np.exp(x[3:])])).max()
        known = memory is not None or np.sqrt(np.diag(covariance).max()) < FIRST_SD
        return bool(np.exp(x[0]) * fastest < 1.0 and known)

    def _remember(self, memory: Memory | None, found: Fit) -> Memory:
        x, covariance, _ = found.indicators
        measured = (float(x[1]), float(covariance[1, 1])), (float(found.p[1]), float(found.covariance[1, 1]))
        if memory is None:
            gain, product = (Trend.at(value, v) for value, v in measured)
        else:
            gain, product = (
                t.follow(value, v / self.share, self.share)
                for t, (value, v) in zip((memory.gain, memory.product), measured, strict=True)
            )
        return Memory(parameters=found.p, gain=gain, product=product, colour=found.colour)


@dataclass(frozen=True, kw_only=True)
class Printed:
    """Chapter III as printed: N4SID at the full rate, the fastest pole is the sensor, (3.13) its gain.

    ``k_s = k_k std(e)`` up to std(w_p), with k_k the pole-zero gain of C (q I - A)^-1 K, and the plant's
    gain from the static gain of C (q I - A)^-1 B, which is their product. It has no covariance."""

    structure: Structure
    horizon: int

    def estimate(self, u: Array, y: Array, memory: Memory | None, state: Array | None) -> Estimate | None:
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
