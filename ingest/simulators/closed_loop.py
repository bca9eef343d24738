"""One run of plant, sensors and control unit: arrays in, named columns out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ingest.errors import DynoscopeError
from ingest.physics import AIR, EXHAUST, O2_AIR
from ingest.simulators.faults import SENSORS, FaultInputs
from ingest.simulators.parameters import RATE_HZ, Control, Plant, Sensors
from ingest.simulators.plant import run

__all__ = ["COLUMNS", "NOISE", "simulate"]

Array = NDArray[np.float64]

SETTLE_S = 20.0  # simulated ahead of the first sample
STATES = ("p_Bst", "m_Bst", "p_Int", "m_Air", "m_Egr", "m_O2", "m_Exh", "w_Turb", "T_Exh")
FLOWS = ("W_Comp", "W_Thr", "W_Cyl", "W_LeakBst", "W_LeakInt", "W_Egr", "W_Turb")
NOISE = (*SENSORS, "p_Bst.adc", "p_Int.adc", "p_Exh")  # columns of unit white noise
COLUMNS = (  # as plant.run fills them
    *(f"read.{s}" for s in SENSORS),
    *(f"healthy.{s}" for s in SENSORS),
    *("read.p_Exh", "read.T_Bst", "read.1/lambda"),
    *("n_Eng", "W_Fuel", "u_Vnt", "u_Egr", "x_Egr"),  # x_Egr: true position of the EGR valve, 0..1
    *FLOWS,
    *STATES,
)


def simulate(
    *,
    drive: Array,
    noise: Array,
    faults: FaultInputs,
    egr_active: bool,
    plant: Plant,
    control: Control,
    sensors: Sensors,
    steps: int = 12,
) -> dict[str, Array]:
    """Everything about the run at 50 Hz by the names of COLUMNS, SI units (engine speed in rpm).

    ``drive`` (n, 2): engine speed (rpm) and demanded fuel (kg/s); ``noise`` (n, 7): unit white noise, columns
    NOISE; ``steps``: RK4 steps per sample (12 leave an error of 0.4 Pa, 10 of 1 Pa: the throttle is stiff).
    The engine has settled at the first sample's inputs before the run.

    Raises:
        DynoscopeError: the engine leaves its physical range.
    """
    settle = round(SETTLE_S * RATE_HZ)
    ahead = ((settle, 0), (0, 0))
    out = np.empty((settle + len(drive), len(COLUMNS)))
    run(
        np.pad(drive, ahead, mode="edge"),
        np.pad(noise, ahead),
        FaultInputs(*(np.pad(a, ahead, mode="edge") for a in faults)),
        egr_active,
        steps,
        _idle(plant),
        plant,
        control,
        sensors,
        out,
    )
    lost = ~np.isfinite(out).all(axis=1)
    if lost.any():
        raise DynoscopeError(
            f"the simulated engine leaves its physical range at {np.argmax(lost) / RATE_HZ - SETTLE_S:g} s; "
            "bring the parameters that were set nearer to their defaults"
        )
    return dict(zip(COLUMNS, out[settle:].T, strict=True))


def _idle(P: Plant) -> Array:
    """States and sensor lags near idle: all at ambient pressure, the turbocharger turning slowly."""
    p, T, T_Exh, w, W_HFM = P.p_Amb, P.T_Amb, P.T_Amb + 150.0, 3000.0, 0.013
    m_Bst, m_Int, m_Exh = (
        p * P.V_Bst / (AIR.R * T),
        p * P.V_Int / (AIR.R * T),
        p * P.V_Exh / (EXHAUST.R * T_Exh),
    )
    states = (p, m_Bst, p, m_Int, 0.0, O2_AIR * m_Int, m_Exh, w, T_Exh)
    return np.array([*states, p, p, p, T, T, W_HFM, 0.2])
