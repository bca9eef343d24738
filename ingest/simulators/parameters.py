"""Parameters of plant, control unit and sensors.

They are named tuples, not data classes, because the compiled kernel takes them as they are. The structure
follows the dissertation (5.4)-(5.35) and Wahlström and Eriksson (2011); the values are choices for a 2.2 l
four-cylinder engine. SI units, speeds of the engine in rpm.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["Q_LHV", "RATE_HZ", "Control", "Plant", "Sensors"]

RATE_HZ = 50.0  # of the control unit and of the log
Q_LHV = 42.7e6  # lower heating value of diesel fuel, J/kg


class Plant(NamedTuple):
    """Engine, manifolds, turbocharger, charge air cooler, EGR path and surroundings."""

    V_eng: float = 2.179e-3
    V_Bst: float = 9.0e-3
    V_Int: float = 6.5e-3
    V_Exh: float = 2.5e-3
    A_Thr: float = 7.0e-4  # effective, wide open, including the charge air cooler
    Pi_lin_Thr: float = 0.99
    A_Egr: float = 2.9e-4  # effective, valve open
    Pi_lin_Egr: float = 0.96
    Cd_leak: float = 0.65
    c_v0: float = 0.800  # volumetric efficiency c_v0 + c_v1 n + c_v2 n^2
    c_v1: float = 1.10e-4
    c_v2: float = -2.3e-8
    r_c: float = 16.5
    f_comb_0: float = 0.40  # share of the fuel's heat in the exhaust
    f_comb_lambda: float = 0.055
    f_comb_n: float = 0.02
    tau_Exh: float = 0.06
    D_comp: float = 50.5e-3
    psi_max: float = 1.18
    phi_max: float = 0.215
    eta_comp_max: float = 0.76
    phi_opt: float = 0.6  # of phi_max
    eta_comp_width: float = 0.95
    A_Vnt_min: float = 0.9e-4
    A_Vnt_max: float = 5.6e-4
    D_turb: float = 44.0e-3
    K_turb: float = 2.2
    eta_turb_max: float = 0.66
    BSR_opt: float = 0.62
    J_turb: float = 3.0e-5
    eta_mech: float = 0.96
    damping: float = 5.0e-7
    k_filter: float = 1.3e5  # pressure loss of the air filter over flow squared
    k_exhaust: float = 1.0e6
    cac_0: float = 0.88  # effectiveness of the charge air cooler, cac_0 - cac_1 W
    cac_1: float = 1.4
    eta_EgrCooler: float = 0.75
    T_coolant: float = 360.0
    p_Amb: float = 101.3e3
    T_Amb: float = 293.15


class Control(NamedTuple):
    """Boost control by the turbine vanes, EGR control by the valve, smoke limit by the fuel."""

    boost_max: float = 1.0e5  # set-point above ambient
    load_boost: float = 0.75  # share of full load from which it holds
    n_boost_0: float = 900.0
    n_boost_1: float = 1900.0
    m_Fuel_max: float = 62e-6  # kg per stroke at full load
    tau_set: float = 0.5
    Kp_boost: float = 0.45e-5
    Ki_boost: float = 0.35e-5
    ff_0: float = 1.15
    ff_n: float = -1.8e-4
    ff_load: float = -0.2
    ff_max: float = 0.85
    floor: float = 0.5  # least vane position over feed-forward
    trim_max: float = 0.2  # most of it above feed-forward: a dead boost sensor must not burst the engine
    lambda_smoke: float = 1.3
    x_Egr_max: float = 0.30
    load_Egr: float = 0.42  # no recirculation above it, all 0.2 below
    Kp_Egr: float = 0.6
    Ki_Egr: float = 1.5
    dp_Egr_shut: float = 8e3  # the valve stays shut while boost exceeds its set-point by more
    tau_Vnt: float = 0.12
    tau_Egr: float = 0.08


class Sensors(NamedTuple):
    """Time constants (s), noise (standard deviation; of the flow relative, else absolute), tolerances."""

    tau_p: float = 0.012
    tau_HFM: float = 0.035
    tau_T: float = 2.0
    tau_lambda: float = 0.1
    lpf: float = 180.0  # pressures are filtered with the time constant lpf/n
    sd_p: float = 350.0  # per sample, before the filter
    sd_p_adc: float = 50.0  # after it
    sd_HFM: float = 0.02
    sd_T: float = 0.1
    gain_HFM: float = 1.0
    offset_p_Bst: float = 0.0
    offset_p_Int: float = 0.0
    offset_T_Int: float = 0.0
