"""Gas data, compressible flow through an orifice, and linear dynamics under a held input.

Source of the flow: dissertation, equations (5.6) and (5.7), with the corrections that the printed form
needs: the pressure ratio is downstream over upstream, the factor sqrt(2) belongs to Phi (only then is an area
a geometric one), and the choked value is that of the critical ratio, so that Phi is continuous.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "AIR",
    "EXHAUST",
    "O2_AIR",
    "O2_PER_FUEL",
    "Gas",
    "critical_ratio",
    "flow_function",
    "orifice_flow",
    "zero_order_hold",
]

# A number or an array of numbers; Any, as the same source is also compiled for scalars.
Real = Any


@dataclass(frozen=True, kw_only=True)
class Gas:
    """An ideal gas: gas constant ``R`` and specific heat ``c_p`` in J/(kg K).

    >>> round(AIR.kappa, 3), round(AIR.c_v)
    (1.4, 718)
    """

    R: float
    c_p: float

    @property
    def c_v(self) -> float:
        return self.c_p - self.R

    @property
    def kappa(self) -> float:
        return self.c_p / self.c_v


AIR = Gas(R=287.0, c_p=1005.0)
EXHAUST = Gas(R=286.0, c_p=1130.0)
O2_AIR = 0.2314  # mass fraction; 21 % is the volume fraction
O2_PER_FUEL = 14.6 * O2_AIR  # kg of oxygen for 1 kg of diesel fuel


def critical_ratio(kappa: float) -> float:
    """Pressure ratio below which the flow is choked, ``(2/(kappa+1))^(kappa/(kappa-1))``.

    >>> round(critical_ratio(1.4), 4)
    0.5283
    """
    return float((2.0 / (kappa + 1.0)) ** (kappa / (kappa - 1.0)))


def flow_function(Pi: Real, kappa: float, Pi_crit: float, Pi_lin: float) -> Real:
    """Flow function (5.7) of the pressure ratio ``Pi = p_dn/p_up`` in 0..1, dimensionless.

    ``Phi(Pi) = sqrt(2 kappa/(kappa-1) (Pi^(2/kappa) - Pi^((kappa+1)/kappa)))`` between ``Pi_crit`` and
    ``Pi_lin``; constant below ``Pi_crit``; above ``Pi_lin`` a straight line to Phi(1) = 0, as the slope of
    the root grows without limit there and would make any volume behind it infinitely stiff.

    >>> float(round(flow_function(0.3, 1.4, critical_ratio(1.4), 0.99), 4))
    0.6847
    >>> float(flow_function(1.0, 1.4, critical_ratio(1.4), 0.99))
    0.0
    """
    r = np.minimum(np.maximum(Pi, Pi_crit), Pi_lin)
    a = r ** (1.0 / kappa)
    phi = np.sqrt(2.0 * kappa / (kappa - 1.0) * a * (a - r))
    return phi * np.minimum(1.0, (1.0 - Pi) / (1.0 - Pi_lin))


def orifice_flow(
    area: Real,
    p_up: Real,
    T_up: Real,
    p_dn: Real,
    *,
    T_dn: Real | None = None,
    gas: Gas = AIR,
    Pi_lin: float = 0.99,
) -> NDArray[np.float64]:
    """Mass flow (5.6) through an orifice in kg/s, positive from ``up`` to ``dn``; all arguments broadcast.

    ``W = A p/sqrt(R T) Phi(p_other/p)`` with pressure (Pa) and temperature (K) of the side with the higher
    pressure; ``area`` is effective, in m2. Where ``p_dn > p_up`` the flow is negative and the gas has
    temperature ``T_dn`` (None: ``T_up``).

    >>> area = 0.65 * np.pi / 4 * 4e-3**2  # a hole of 4 mm
    >>> round(float(orifice_flow(area, 160e3, 330.0, 100e3)) * 1e3, 3)  # g/s
    2.847
    """
    forward = np.greater_equal(p_up, p_dn)
    high, low = np.maximum(p_up, p_dn), np.minimum(p_up, p_dn)
    T: Real = np.where(forward, T_up, T_up if T_dn is None else T_dn)
    phi = flow_function(low / high, gas.kappa, critical_ratio(gas.kappa), Pi_lin)
    W: NDArray[np.float64] = area * high / np.sqrt(gas.R * T) * phi
    return np.where(forward, W, -W)


def zero_order_hold(
    A: NDArray[np.float64], B: NDArray[np.float64], dt: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``Ad, Bd`` of ``x' = A x + B u`` for an input held over ``dt``; shapes (..., n, n) and (..., n, m).

    ``exp([[A, B], [0, 0]] dt)`` by Taylor's series after scaling, for many systems at once.

    >>> Ad, Bd = zero_order_hold(np.array([[-2.0]]), np.array([[2.0]]), 0.5)
    >>> bool(np.isclose(Ad, np.exp(-1.0))), bool(np.isclose(Bd, 1.0 - np.exp(-1.0)))
    (True, True)
    """
    n, m = B.shape[-2:]
    M = np.zeros((*B.shape[:-2], n + m, n + m))
    M[..., :n, :n], M[..., :n, n:] = A, B
    norm = float((dt * np.abs(M)).sum(axis=-1).max())
    halvings = max(0, math.ceil(math.log2(norm / 0.25))) if norm > 0.0 else 0
    M *= dt / 2.0**halvings
    power, F = M, np.eye(n + m) + M
    for k in range(2, 13):  # 0.25^13 / 13! is far below a unit in the last place
        power = power @ M / k
        F = F + power
    for _ in range(halvings):
        F = F @ F
    return np.ascontiguousarray(F[..., :n, :n]), np.ascontiguousarray(F[..., :n, n:])
