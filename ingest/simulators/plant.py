"""The diesel air path with its sensors and its control unit, compiled.

Gas path (5.4)-(5.31) with the corrections stated at each line, integrated by RK4 in steps of 1.7 ms between
the 50 Hz samples at which sensors are read and the control unit acts. The control unit sees what the sensors
say, so a sensor fault acts back on the engine. The first use in an installation compiles (some seconds) and
leaves the result in numba's cache.

All compiled functions are in this file, as numba's cache does not notice a change in another one.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp, pi, sqrt
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ingest.physics import AIR, EXHAUST, O2_AIR, O2_PER_FUEL, critical_ratio, flow_function
from ingest.simulators.faults import FaultInputs
from ingest.simulators.parameters import Q_LHV, RATE_HZ, Control, Plant, Sensors

__all__ = ["run"]

Array = NDArray[np.float64]

R_A, CP_A, CV_A, K_A = AIR.R, AIR.c_p, AIR.c_v, AIR.kappa
R_E, CP_E, CV_E, K_E = EXHAUST.R, EXHAUST.c_p, EXHAUST.c_v, EXHAUST.kappa
CRIT_A, CRIT_E = critical_ratio(K_A), critical_ratio(K_E)
E_A, E_E = (K_A - 1.0) / K_A, (K_E - 1.0) / K_E

F_ = TypeVar("F_", bound=Callable[..., Any])


def _compile(function: F_) -> F_:
    """Compiled; a division by zero gives NaN, which the caller looks for."""
    return cast(F_, njit(cache=True, error_model="numpy")(function))


def _inlined(function: F_) -> F_:
    """Compiled into the one function that calls it, and not with all those that call that one."""
    return cast(F_, njit(inline="always")(function))


_flow_function: Callable[..., float] = _compile(flow_function)


@_compile
def _orifice(area: float, p_up: float, T_up: float, p_dn: float, T_dn: float, air: bool, lin: float) -> float:
    """``physics.orifice_flow`` for scalars: air, or exhaust gas forwards (backwards R differs by < 0.4 %)."""
    if area <= 0.0:
        return 0.0
    R, kappa, crit = (R_A, K_A, CRIT_A) if air else (R_E, K_E, CRIT_E)
    if p_up >= p_dn:
        return area * p_up / sqrt(R * T_up) * _flow_function(p_dn / p_up, kappa, crit, lin)
    return -area * p_dn / sqrt(R * T_dn) * _flow_function(p_up / p_dn, kappa, crit, lin)


@_inlined
def _compressor(w: float, p_dn: float, p_up: float, P: Plant) -> tuple[float, float, float]:
    """Flow (kg/s), outlet temperature (K), power (W).

    Elliptic speed lines ``W = W_max(w) sqrt(1 - (Pi/Pi_max(w))^2)``, straight in the last 2 % before surge,
    where the root's slope has no limit.
    """
    U = 0.5 * w * P.D_comp
    W_max = P.phi_max * p_up / (R_A * P.T_Amb) * pi * (0.5 * P.D_comp) ** 2 * U
    Pi, Pi_max = p_dn / p_up, (1.0 + 0.5 * P.psi_max * U * U / (CP_A * P.T_Amb)) ** (1.0 / E_A)
    ratio = min(Pi / Pi_max, 1.0)
    phi = sqrt(1.0 - min(ratio, 0.98) ** 2) * min(1.0, (1.0 - ratio) / 0.02)
    eta = P.eta_comp_max * max(0.4, 1.0 - ((phi - P.phi_opt) / P.eta_comp_width) ** 2)
    dT = P.T_Amb * max(Pi**E_A - 1.0, 0.0) / eta
    return W_max * phi, P.T_Amb + dT, W_max * phi * CP_A * dT


@_inlined
def _turbine(w: float, area: float, p_up: float, T_up: float, p_dn: float, P: Plant) -> tuple[float, float]:
    """Flow (kg/s) and power (W): ``sqrt(1 - Pi^K)`` and an efficiency over the blade speed ratio, both of
    Wahlström and Eriksson (2011); straight above Pi = 0.97."""
    Pi = min(p_dn / p_up, 1.0)
    phi = sqrt(1.0 - min(Pi, 0.97) ** P.K_turb) * min(1.0, (1.0 - Pi) / 0.03)
    W = area * p_up / sqrt(R_E * T_up) * phi
    dh = CP_E * T_up * (1.0 - Pi**E_E)
    BSR = 0.5 * P.D_turb * w / sqrt(2.0 * max(dh, 1.0))
    return W, W * dh * P.eta_turb_max * max(1.0 - (BSR / P.BSR_opt - 1.0) ** 2, 0.05)


@_inlined
def _flows(x: Array, u: Array, P: Plant, f: Array) -> None:
    """All that follows algebraically from states ``x`` and inputs ``u``: flows, temperatures, powers."""
    p_Bst, m_Bst, p_Int, m_Air, m_Egr, m_Exh, w, T_Exh = x[0], x[1], x[2], x[3], x[4], x[6], x[7], x[8]
    n, W_Fuel, A_Vnt, x_Egr, A_LeakBst, A_LeakInt = u[0], u[1], u[2], u[3], u[4], u[5]
    m_Int = m_Air + m_Egr
    R_Int = R_A + m_Egr / m_Int * (R_E - R_A)  # (5.16)
    T_Bst, T_Int = p_Bst * P.V_Bst / (m_Bst * R_A), p_Int * P.V_Int / (m_Int * R_Int)  # (5.14)
    p_Exh = m_Exh * R_E * T_Exh / P.V_Exh  # (5.20)

    f_vol = P.c_v0 + n * (P.c_v1 + n * P.c_v2)
    f_vol *= (P.r_c - (p_Exh / p_Int) ** (1.0 / K_E)) / (P.r_c - 1.0)
    W_Cyl = f_vol * n / 120.0 * P.V_eng * p_Int / (R_Int * T_Int)  # (5.17)
    W_Egr = _orifice(P.A_Egr * x_Egr, p_Exh, T_Exh, p_Int, T_Int, False, P.Pi_lin_Egr)  # (5.12)
    W_LeakInt = _orifice(A_LeakInt, p_Int, T_Int, P.p_Amb, P.T_Amb, True, 0.99)  # (5.31)
    eps = max(P.cac_0 - P.cac_1 * max(W_Cyl + W_LeakInt - W_Egr, 0.0), 0.2)  # what passes the cooler
    T_Cac = T_Bst - eps * (T_Bst - P.T_Amb)
    W_Thr = _orifice(P.A_Thr, p_Bst, T_Cac, p_Int, T_Int, True, P.Pi_lin_Thr)  # (5.6), cooled
    W_LeakBst = _orifice(A_LeakBst, p_Bst, T_Bst, P.p_Amb, P.T_Amb, True, 0.99)  # (5.26), its own pressure
    # pressure losses of filter and exhaust from the flow on the other side: no algebraic loop
    p_Filter = P.p_Amb - P.k_filter * max(W_Thr + W_LeakBst, 0.0) ** 2
    p_Post = P.p_Amb + P.k_exhaust * max(W_Cyl + W_Fuel - W_Egr, 0.0) ** 2
    W_Comp, T_Comp, P_Comp = _compressor(w, p_Bst, p_Filter, P)
    W_Turb, P_Turb = _turbine(w, A_Vnt, p_Exh, T_Exh, p_Post, P)  # (5.22)

    f[0], f[1], f[2], f[3], f[4], f[5], f[6] = W_Comp, W_Thr, W_Cyl, W_LeakBst, W_LeakInt, W_Egr, W_Turb
    f[7], f[8], f[9], f[10], f[11], f[12] = T_Bst, T_Int, T_Cac, T_Comp, P_Comp, P_Turb


@_compile
def _derivatives(x: Array, u: Array, P: Plant, S: Sensors, dx: Array, f: Array) -> None:
    """Time derivatives ``dx`` of states and sensor lags ``x``; ``f`` as left by ``_flows``."""
    _flows(x, u, P, f)
    W_Comp, W_Thr, W_Cyl, W_LeakBst, W_LeakInt, W_Egr, W_Turb = f[0], f[1], f[2], f[3], f[4], f[5], f[6]
    T_Bst, T_Int, T_Cac, T_Comp, P_Comp, P_Turb = f[7], f[8], f[9], f[10], f[11], f[12]
    n, W_Fuel, w, T_Exh = u[0], u[1], x[7], x[8]
    m_Int = x[3] + x[4]
    egr, rO2 = x[4] / m_Int, x[5] / m_Int  # (5.15)
    R_Int, cv_Int = R_A + egr * (R_E - R_A), CV_A + egr * (CV_E - CV_A)
    p_Exh = x[6] * R_E * T_Exh / P.V_Exh

    # boost manifold (5.24), (5.25): what leaves carries T_Bst, what leaks in T_Amb
    thr, thr_back, inwards = max(W_Thr, 0.0), max(-W_Thr, 0.0), max(-W_LeakBst, 0.0)
    out = thr + max(W_LeakBst, 0.0)
    heat = W_Comp * T_Comp + inwards * P.T_Amb + thr_back * T_Int - out * T_Bst
    dx[0] = R_A / (P.V_Bst * CV_A) * CP_A * heat
    dx[1] = W_Comp + inwards + thr_back - out
    # intake manifold (5.27)-(5.30): leaks both ways, all that leaves is the mixture; EGR cooler for (5.13)
    T_Egr = T_Exh - P.eta_EgrCooler * (T_Exh - P.T_coolant)
    inwards, egr_in = max(-W_LeakInt, 0.0), max(W_Egr, 0.0)
    out = W_Cyl + max(W_LeakInt, 0.0) + max(-W_Egr, 0.0) + thr_back
    heat = CP_A * (thr * T_Cac + inwards * P.T_Amb) + CP_E * egr_in * T_Egr - (cv_Int + R_Int) * out * T_Int
    fuel_air = W_Fuel * O2_PER_FUEL / (W_Cyl * rO2)  # 1/lambda
    rO2_Exh = max(W_Cyl * rO2 * (1.0 - fuel_air), 0.0) / (W_Cyl + W_Fuel)
    dx[2] = R_Int / (P.V_Int * cv_Int) * heat
    dx[3] = thr + inwards - (1.0 - egr) * out
    dx[4] = egr_in - egr * out
    dx[5] = O2_AIR * (thr + inwards) + rO2_Exh * egr_in - rO2 * out
    # exhaust manifold (5.18), (5.19), (5.21) and turbocharger
    f_comb = P.f_comb_0 + P.f_comb_lambda * (1.0 - fuel_air) + P.f_comb_n * (n - 2000.0) / 2000.0
    dx[6] = W_Cyl + W_Fuel - W_Turb - W_Egr
    dx[7] = (P_Turb * P.eta_mech - P_Comp - P.damping * w * w) / (P.J_turb * w)
    dx[8] = (T_Int + f_comb * W_Fuel * Q_LHV / (CP_E * (W_Cyl + W_Fuel)) - T_Exh) / P.tau_Exh
    # sensors, first order (5.32), (5.34), (5.35)
    dx[9], dx[10], dx[11] = (x[0] - x[9]) / S.tau_p, (x[2] - x[10]) / S.tau_p, (p_Exh - x[11]) / S.tau_p
    dx[12], dx[13] = (T_Bst - x[12]) / S.tau_T, (T_Int - x[13]) / S.tau_T
    dx[14], dx[15] = (W_Comp - x[14]) / S.tau_HFM, (fuel_air - x[15]) / S.tau_lambda


@_compile
def _advance(
    x: Array, u_0: Array, u_1: Array, steps: int, P: Plant, S: Sensors, K: Array, u: Array, f: Array
) -> None:
    """RK4 over one sample in ``steps`` steps; inputs go straight from ``u_0`` to ``u_1``. ``K``: work."""
    h = 1.0 / (RATE_HZ * steps)
    for i in range(steps):
        for stage in range(4):
            c = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            for j in range(u.size):
                u[j] = u_0[j] + (i + c) / steps * (u_1[j] - u_0[j])
            for j in range(x.size):
                K[4, j] = x[j] if stage == 0 else x[j] + c * h * K[stage - 1, j]
            _derivatives(K[4], u, P, S, K[stage], f)
        for j in range(x.size):
            x[j] += h / 6.0 * (K[0, j] + 2.0 * K[1, j] + 2.0 * K[2, j] + K[3, j])


@_compile
def _ramp(x: float, low: float, high: float) -> float:
    """0 up to ``low``, 1 from ``high`` on."""
    return min(max((x - low) / (high - low), 0.0), 1.0)


@_inlined
def _control(
    c: Array, n: float, demand: float, read: Array, alpha: float, egr_active: bool, P: Plant, C: Control
) -> tuple[float, float, float]:
    """Commands of vanes (1 = closed) and EGR valve (1 = open), fuel limit (kg/s), from measured signals.

    ``c``: boost set-point, both integrators, filtered air flow. Boost: PI with feed-forward on p_Bst. EGR: PI
    on the fraction ``1 - W_HFM/W_Cyl``, W_Cyl by speed and density. Smoke: ``W_Fuel <= W_HFM/(14.6 lambda)``.
    """
    c[3] += alpha * (read[0] - c[3])
    load = min(demand * 30.0 / (n * C.m_Fuel_max), 1.0)
    boost = C.boost_max * _ramp(load, 0.0, C.load_boost) * _ramp(n, C.n_boost_0, C.n_boost_1)
    c[0] += (1.0 - exp(-1.0 / (RATE_HZ * C.tau_set))) * (P.p_Amb + boost - c[0])
    ff = min(max(C.ff_0 + C.ff_n * n + C.ff_load * load, 0.0), C.ff_max)
    error = c[0] - read[1]
    vnt = ff + C.Kp_boost * error + c[1]
    low, high = C.floor * ff, min(ff + C.trim_max, 1.0)
    if low < vnt < high or error * (vnt - ff) < 0.0:  # do not wind up against a stop
        c[1] += C.Ki_boost * error / RATE_HZ
    vnt = min(max(vnt, low), high)

    egr = 0.0
    wanted = C.x_Egr_max * _ramp(n, 900.0, 1200.0) * _ramp(C.load_Egr - load, 0.0, 0.2)
    decaying = read[1] - c[0] > C.dp_Egr_shut  # boost above its set-point would flow backwards
    if egr_active and wanted > 0.0 and demand > 0.0 and not decaying:
        density = max(read[2], 1e4) / (R_A * max(read[3], 200.0))  # a dead sensor must not stop the valve
        W_Cyl = (P.c_v0 + n * (P.c_v1 + n * P.c_v2)) * n / 120.0 * P.V_eng * density
        error = wanted - (1.0 - c[3] / W_Cyl)
        c[2] = min(max(c[2] + C.Ki_Egr * error / RATE_HZ, 0.0), 1.0)
        egr = min(max(c[2] + C.Kp_Egr * error, 0.0), 1.0)
    else:
        c[2] = 0.0
    return vnt, egr, c[3] / (14.6 * C.lambda_smoke)


@_inlined
def _sense(
    k: int,
    x: Array,
    alpha: float,
    noise: Array,
    F: FaultInputs,
    S: Sensors,
    held: Array,
    filtered: Array,
    y: Array,
) -> None:
    """What the four sensors read (``y[0]``) and would read if healthy (``y[1]``), with the same noise."""
    y[1, 0] = x[14] * (S.gain_HFM + S.sd_HFM * noise[k, 0])
    y[1, 1] = x[9] + S.offset_p_Bst + S.sd_p * noise[k, 1]
    y[1, 2] = x[10] + S.offset_p_Int + S.sd_p * noise[k, 2]
    y[1, 3] = x[13] + S.offset_T_Int + S.sd_T * noise[k, 3]
    for j in range(4):
        y[0, j] = F.gain[k, j] * y[1, j] + F.offset[k, j]
        if F.stuck[k, j] <= 0.0:
            held[j] = y[0, j]
        y[0, j] += F.stuck[k, j] * (F.hold[k, j] * held[j] - y[0, j])
    for j in range(1, 3):  # the pressures pass the filter (5.33)
        for i in range(2):
            filtered[i, j - 1] += alpha * (y[i, j] - filtered[i, j - 1])
            y[i, j] = filtered[i, j - 1] + S.sd_p_adc * noise[k, 3 + j]


@_compile
def _inputs(
    u: Array, n: float, fuel: float, vnt: float, valve: float, k: int, F: FaultInputs, P: Plant
) -> None:
    """Plant inputs ``u`` at sample k: speed, fuel, vane area, position of the EGR valve, leak areas."""
    u[0], u[1] = n, fuel
    u[2] = P.A_Vnt_min + (1.0 - vnt) * (P.A_Vnt_max - P.A_Vnt_min)
    u[3] = valve + F.egr[k, 0] * (F.egr[k, 1] - valve)
    u[4], u[5] = P.Cd_leak * F.leak[k, 0], P.Cd_leak * F.leak[k, 1]


@_compile
def run(
    drive: Array,
    noise: Array,
    F: FaultInputs,
    egr_active: bool,
    steps: int,
    x: Array,
    P: Plant,
    C: Control,
    S: Sensors,
    out: Array,
) -> None:
    """Drives the plant from state ``x`` through all samples and fills ``out``, one row of COLUMNS each."""
    K, u, u_0, u_1, f = np.zeros((5, x.size)), np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(13)
    held, filtered, y = np.zeros(4), np.empty((2, 2)), np.zeros((2, 4))
    filtered[:, 0], filtered[:, 1] = x[9], x[10]
    c = np.zeros(4)
    c[0], c[3] = P.p_Amb, x[14]
    vnt, valve, p_Exh = 0.5, 0.0, x[11]
    _inputs(u_0, drive[0, 0], drive[0, 1], vnt, valve, 0, F, P)
    for k in range(drive.shape[0]):
        n = drive[k, 0]
        alpha = 1.0 - exp(-n / (RATE_HZ * S.lpf))
        _sense(k, x, alpha, noise, F, S, held, filtered, y)
        p_Exh += alpha * (x[11] + S.sd_p * noise[k, 6] - p_Exh)
        _derivatives(x, u_0, P, S, K[0], f)
        for j in range(4):  # whole rows take long to compile
            out[k, j], out[k, 4 + j] = y[0, j], y[1, j]
        out[k, 8], out[k, 9], out[k, 10] = p_Exh, x[12], x[15]
        out[k, 11], out[k, 12], out[k, 13], out[k, 14], out[k, 15] = n, u_0[1], vnt, valve, u_0[3]
        for j in range(7):
            out[k, 16 + j] = f[j]
        for j in range(9):
            out[k, 23 + j] = x[j]
        if k + 1 < drive.shape[0]:
            command, opening, limit = _control(c, n, drive[k, 1], y[0], alpha, egr_active, P, C)
            vnt += (1.0 - exp(-1.0 / (RATE_HZ * C.tau_Vnt))) * (command - vnt)
            valve += (1.0 - exp(-1.0 / (RATE_HZ * C.tau_Egr))) * (opening - valve)
            valve = 0.0 if valve < 1e-6 else valve  # shut, not forever nearly so
            _inputs(u_1, drive[k + 1, 0], min(drive[k + 1, 1], limit), vnt, valve, k + 1, F, P)
            _advance(x, u_0, u_1, steps, P, S, K, u, f)
            for j in range(6):
                u_0[j] = u_1[j]
