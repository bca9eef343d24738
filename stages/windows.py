"""Windows: an analysis group cut into stretches of equal length without a gap, however the log is cut.

Windows start every ``hop`` samples from the first on, and overlap where that is less than their length. A
gap, a missing value or a step of another length ends the stretch; the next window starts after it, and what
was left of the old one is dropped."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError

Array = NDArray[np.float64]
JITTER = 0.5  # of a step: time stamps may be off by this
ENOUGH = 10  # steps, to say that the rate is another


@dataclass(frozen=True, eq=False)
class Rest:
    """Samples that do not fill a window yet: time (k,) and values (k, channels)."""

    time: Array
    values: Array


@dataclass(frozen=True, kw_only=True)
class Windows:
    """``length`` samples, ``dt`` (s) apart; a window starts ``hop`` samples after the one before."""

    length: int
    hop: int
    dt: float

    @property
    def share(self) -> float:
        """Of a window's samples, those that the one before does not have."""
        return self.hop / self.length

    def start(self, channels: int) -> Rest:
        return Rest(np.empty(0), np.empty((0, channels)))

    def cut(self, rest: Rest, time: Array, values: Array) -> tuple[Rest, list[tuple[float, Array]]]:
        """The rest, and end time (that of the last sample plus a step) and values (length, channels) of each
        window that is now complete.

        Raises:
            LogError: the samples are not ``dt`` apart.
        """
        time, values = np.concatenate([rest.time, time]), np.concatenate([rest.values, values])
        known = np.isfinite(values).all(axis=1)
        time, values = time[known], values[known]
        steps = np.diff(time)
        if steps.size >= ENOUGH and not (np.abs(steps - self.dt) < 0.1 * self.dt).any():
            raise LogError(
                f"the samples are {np.median(steps):.4g} s apart, the recipe expects {self.dt:.4g} s; "
                "set its rate_hz, or raster_s of its stage align"
            )
        breaks = np.flatnonzero(np.abs(steps - self.dt) > JITTER * self.dt) + 1
        edges = [0, *breaks.tolist(), time.size]
        windows, rest = [], Rest(time[:0], values[:0])
        for first, end in pairwise(edges):
            while end - first >= self.length:
                last = first + self.length
                windows.append((float(time[last - 1]) + self.dt, values[first:last]))
                first += self.hop
            if end == time.size:
                rest = Rest(time[first:], values[first:])
        return rest, windows
