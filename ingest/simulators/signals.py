"""What the air-path simulator logs: names, units, the noise of the logging, and how the tables are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import TIME, Group, Signal
from ingest.simulators.faults import SENSORS

__all__ = ["ECU", "TRUTH", "Column", "group"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Column:
    """A logged signal: ``factor`` x the simulator's ``source`` (SI), plus white noise ``sd`` in ``unit``."""

    source: str
    unit: str
    text: str
    factor: float = 1.0
    sd: float = 0.0


_READ = {
    "p_Bst": Column(source="read.p_Bst", unit="kPa", factor=1e-3, text="boost pressure ahead of the cooler"),
    "p_Int": Column(source="read.p_Int", unit="kPa", factor=1e-3, text="intake manifold pressure"),
    "T_Int": Column(source="read.T_Int", unit="K", text="intake manifold temperature"),
    "W_HFM": Column(source="read.W_HFM", unit="g/s", factor=1e3, text="inducted air, hot-film meter"),
}
ECU = {
    **_READ,
    "p_Exh": Column(source="read.p_Exh", unit="kPa", factor=1e-3, sd=0.05, text="exhaust manifold pressure"),
    "p_Amb": Column(source="p_Amb", unit="kPa", factor=1e-3, sd=0.05, text="ambient pressure"),
    "T_Bst": Column(source="read.T_Bst", unit="K", sd=0.1, text="boost temperature ahead of the cooler"),
    "T_Amb": Column(source="T_Amb", unit="K", sd=0.1, text="ambient temperature"),
    "W_Fuel": Column(source="W_Fuel", unit="g/s", factor=1e3, text="injected fuel"),
    "n_Eng": Column(source="n_Eng", unit="rpm", sd=2.0, text="engine speed"),
    "n_Turb": Column(source="n_Turb", unit="rpm", sd=30.0, text="turbocharger speed"),
    "theta_Thr": Column(source="theta_Thr", unit="%", text="throttle position, 100 is open"),
    "u_Egr": Column(source="u_Egr", unit="%", factor=100.0, text="EGR valve, as commanded, 100 is open"),
    "u_Vnt": Column(source="u_Vnt", unit="%", factor=100.0, text="turbine vanes, 100 is closed"),
    "lambda": Column(source="lambda", unit="1", text="air-fuel equivalence ratio, at most 10"),
    "v_Veh": Column(source="v_Veh", unit="km/h", factor=3.6, text="vehicle speed"),
}
_FLOWS = {
    "W_Comp": "air through the compressor",
    "W_Thr": "air through the throttle",
    "W_Cyl": "charge into the cylinders",
    "W_LeakBst": "air lost through the boost leak, negative inwards",
    "W_LeakInt": "charge lost through the intake leak, negative inwards",
    "W_Egr": "recirculated exhaust gas",
}
TRUTH = {
    **{
        f"truth.{s}": Column(
            source=f"healthy.{s}",
            unit=unit,
            factor=_READ[s].factor,
            text=f"{s}, healthy sensor",
        )
        for s, unit in SENSORS.items()
    },
    **{f"truth.{w}": Column(source=w, unit="g/s", factor=1e3, text=text) for w, text in _FLOWS.items()},
    "truth.u_Egr": Column(source="x_Egr", unit="%", factor=100.0, text="EGR valve, true position"),
    "truth.T_Exh": Column(source="T_Exh", unit="K", text="exhaust manifold temperature"),
}


def group(
    name: str,
    columns: Mapping[str, Column],
    run: Mapping[str, Array],
    time: Array,
    rng: np.random.Generator | None = None,
    noise: float = 0.0,
) -> Group:
    """The ``columns`` of a ``run`` as a group; values are float32, as they would be in a recorder."""
    frame: dict[str, Array | NDArray[np.float32]] = {TIME: time}
    for key, column in columns.items():
        value = column.factor * run[column.source]
        if rng is not None and column.sd > 0:
            value += noise * column.sd * rng.standard_normal(len(time))
        frame[key] = value.astype(np.float32)
    signals = {k: Signal(name=k, unit=c.unit, description=c.text) for k, c in columns.items()}
    return Group(name, pl.DataFrame(frame), signals)
