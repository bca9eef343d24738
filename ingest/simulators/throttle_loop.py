"""The throttle's time loop, compiled: plant, two sensors, a noise-free twin, and the controller."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["simulate"]

Array = NDArray[np.float64]


@njit(cache=True)
def simulate(
    Ad: Array,
    Bd: Array,
    which: NDArray[np.int64],
    segment: int,
    control: int,
    control_s: float,
    gains: Array,
    pedal: Array,
    w_p: Array,
    w_n: Array,
) -> Array:  # pragma: no cover - compiled
    """Voltage, angle, reading and healthy reading, shape (4, n).

    ``Ad`` (segments, 5, 5) and ``Bd`` (segments, 5, 2) advance the states (theta, theta', i_a, y, healthy y)
    by a sample; ``which[i]`` is the segment of samples ``i segment ...``. ``gains``: K_P, K_I, K_D, voltage
    limit, the sensor gain that the controller takes for true, and whether it reads sensor or twin. The
    integral holds while the voltage is at its limit.
    """
    K_P, K_I, K_D, limit, k, closed = gains[0], gains[1], gains[2], gains[3], gains[4], gains[5]
    n = w_p.size
    out = np.empty((4, n))
    x, twin, new = np.zeros(5), np.zeros(5), np.zeros(5)
    u, integral, last = 0.0, 0.0, 0.0
    for t in range(n):
        A, B = Ad[which[t // segment]], Bd[which[t // segment]]
        reading = x[3] + w_n[t]
        if t % control == 0:
            angle = (reading if closed > 0.0 else twin[3]) / k
            error = pedal[t // control] - angle
            wanted = K_P * error + integral - K_D * (angle - last) / control_s
            u = min(max(wanted, -limit), limit)
            if u == wanted:
                integral += K_I * error * control_s
            last = angle
        out[0, t], out[1, t], out[2, t], out[3, t] = u, x[0], reading, x[4]
        for noisy in range(2):
            state, w = (x, w_p[t]) if noisy else (twin, 0.0)
            for i in range(5):
                value = B[i, 0] * u + B[i, 1] * w
                for j in range(5):
                    value += A[i, j] * state[j]
                new[i] = value
            state[:] = new
    return out
