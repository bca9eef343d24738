"""Where the prediction-error fit starts: the slow plant from a decimated CVA model, then the fast sensor.

At the full rate a subspace model of plant and sensor together misses the slow poles, as they crowd at 1 (a
subspace horizon of 20 samples of 0.1 ms is 2 ms). So the plant is identified from the signals behind a
low-pass filter, at a rate where its poles are apart. The sensor hardly shows there; its time constant is the
candidate with which the structured model predicts best.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError
from stages.structure import Structure, pack
from stages.subspace import identify, lag_gram

Array = NDArray[np.float64]
SEPARATION = 1.5  # a candidate sensor is this much faster than the plant's fastest pole
CUTOFF = 0.8  # of the decimated Nyquist frequency
SHAPE = 0.2  # r of a sensor with two lags, 0.28 and 0.72 of their sum
TAPS = 20  # of the low-pass filter, for each sample of the decimated signal


@dataclass(frozen=True, kw_only=True)
class TwoRate:
    """``decimation``: full-rate samples to one; ``horizon``: lags of past and future at the low rate."""

    decimation: int = 10
    horizon: int = 20

    @cached_property
    def _low_pass(self) -> Array:
        """A windowed sinc (Hamming) with gain 1 at rest."""
        taps = TAPS * self.decimation + 1
        t = np.arange(taps) - (taps - 1) / 2
        h = np.sinc(t * CUTOFF / self.decimation) * np.hamming(taps)
        return np.asarray(h / h.sum())

    def least_samples(self) -> int:
        """Samples that a window needs."""
        return self.decimation * (4 * self.horizon) + self._low_pass.size

    def decimated(self, u: Array, y: Array) -> tuple[Array, Array]:
        """y and u behind the low-pass filter at the low rate, shape (N, 1) each."""
        windows = np.lib.stride_tricks.sliding_window_view(np.stack([y, u]), self._low_pass.size, axis=1)
        slow = windows[:, :: self.decimation] @ self._low_pass
        return slow[:1].T, slow[1:].T

    def plant(self, structure: Structure, u: Array, y: Array) -> tuple[float, Array, Array, float] | None:
        """b, (a_1 ... a_n), (z_1 ... z_m) in units of a_n, and the fastest pole in 1/s; None where no stable
        plant with positive b is found."""
        try:
            gram = lag_gram(*self.decimated(u, y), self.horizon)
            model = identify(gram, structure.dt * self.decimation, order=structure.plant_order).model
        except (LogError, np.linalg.LinAlgError):  # signals at rest
            return None
        # the fastest may come out as a negative eigenvalue; its distance from the imaginary axis holds
        poles = np.where(np.isclose(model.poles.imag, np.pi / model.dt), model.poles.real, model.poles)
        a_i = np.real(np.poly(poles))[1:]
        b = float(model.gains[0, 0]) * a_i[-1]
        usable = np.isfinite(b) and b > 0.0 and (a_i > 0.0).all() and (poles.real < 0.0).all()
        if not usable:
            return None
        z = model.numerators[0, 0, 1 : structure.zeros + 1] * a_i[-1] ** (
            np.arange(1, structure.zeros + 1) / structure.plant_order
        )
        return b, a_i, np.where(np.isfinite(z), z, 0.0), float(np.abs(poles).max())

    def starts(self, structure: Structure, u: Array, y: Array, last: Array | None) -> list[Array]:
        """Parameter vectors to choose from; ``last``: that of an earlier window, whose sensor is taken on."""
        found = self.plant(structure, u, y)
        if found is None:
            return []
        b, a_i, z, fastest = found
        if last is not None:
            rest = last[structure.plant_order + 2 + structure.zeros :]
            return [pack(float(np.exp(last[0])), b, a_i, np.append(z, rest))]
        candidates = structure.dt * 2.0 ** np.arange(-1, 8)
        shape = [np.log(SHAPE)] * (structure.sensor_order - 1)
        rest = np.concatenate([z, shape, np.zeros(structure.noise_order)])
        return [pack(float(tau), b, a_i, rest) for tau in candidates if tau * fastest < 1.0 / SEPARATION]
