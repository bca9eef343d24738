"""The monitor on a second plant: a thermocouple in a heated gas line, ten thousand times slower.

    python -m benchmarks.thermocouple [--seeds 5]

Heater and pipe wall are lags of 8 s and 1.5 s, the thermocouple one of 0.4 s; power is set every second by
whoever needs heat. The recipe is data/recipes/thermocouple.toml, the stages are those of recipe `throttle`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Event, Group, Log, Signal
from ingest.physics import zero_order_hold
from pipeline.console import print_table
from pipeline.detector import unfitted_detector
from pipeline.diagnosing import diagnose
from pipeline.recipe import load_recipe

Array = NDArray[np.float64]
RATE_HZ = 10.0
DURATION_S, ONSET_S, RAMP_S = 2400.0, 900.0, 900.0
RECIPE = Path(__file__).parents[1] / "data" / "recipes" / "thermocouple.toml"
FAULTS = {
    "none": 0.0, "thermocouple_slow": 0.6, "thermocouple_gain": -0.2, "heater_power": -0.2,
    "wall_fouling": -0.2,
}  # fmt: skip


def system(tau: float, power: float, fouling: float) -> tuple[Array, Array]:
    """States gas temperature, its derivative, reading; inputs power and disturbance between pipe and
    sensor."""
    a1, a2 = (1 / 8.0 + 1 / 1.5) * fouling, fouling / (8.0 * 1.5)
    b = 0.05 * power * fouling / (8.0 * 1.5)  # K/W at rest
    A = np.array([[0.0, 1.0, 0.0], [-a2, -a1, 0.0], [1 / tau, 0.0, -1 / tau]])
    B = np.array([[0.0, 0.0], [b, 0.0], [0.0, 1 / tau]])
    return zero_order_hold(A, B, 1.0 / RATE_HZ)


def thermocouple_log(fault: str, seed: int) -> Log:
    """Deviations from the operating point, in W and K; the fault grows over the second quarter hour."""
    rng = np.random.default_rng([seed, sum(fault.encode())])
    n = int(DURATION_S * RATE_HZ)
    levels = rng.uniform(-400.0, 400.0, n)
    power = np.repeat(levels[: n // 10 + 1], 10)[:n] * (
        np.repeat(rng.uniform(size=n // 50 + 1), 50)[:n] < 0.7
    )
    w_p, w_n = rng.normal(0, 0.15, n), rng.normal(0, 0.03, n)
    time = np.arange(n) / RATE_HZ
    size = 1.0 + FAULTS[fault] * np.clip((time - ONSET_S) / RAMP_S, 0.0, 1.0)
    reading, x = np.empty(n), np.zeros(3)
    for t in range(n):
        if t % 10 == 0:
            now = {f: size[t] if f == fault else 1.0 for f in FAULTS}
            A, B = system(0.4 * now["thermocouple_slow"], now["heater_power"], now["wall_fouling"])
        reading[t] = now["thermocouple_gain"] * x[2] + w_n[t]
        x = A @ x + B @ np.array([power[t], w_p[t]])
    frame = pl.DataFrame({"time": time, "P_heater": power, "T_gas": reading})
    signals = {"P_heater": Signal(name="P_heater", unit="W"), "T_gas": Signal(name="T_gas", unit="K")}
    truth = (
        ()
        if fault == "none"
        else (Event(t_start=ONSET_S, kind=fault, source="truth", magnitude=FAULTS[fault]),)
    )
    return Log(f"{fault}_{seed}", {"line": Group("line", frame, signals)}, truth)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    detector = unfitted_detector(load_recipe(RECIPE))
    rows, right = [], 0
    for fault, magnitude in FAULTS.items():
        verdicts = [diagnose(thermocouple_log(fault, s), detector).verdict for s in range(args.seeds)]
        named = [v.fault for v in verdicts]
        right += named.count(fault)
        sizes = [v.magnitude.value for v in verdicts if v.magnitude and v.fault == fault]
        delays = [v.detected_s - ONSET_S for v in verdicts if v.detected_s is not None]
        rows.append(
            {
                "fault": fault, "right": f"{named.count(fault)}/{args.seeds}", "true size": magnitude,
                "size": float(np.mean(sizes)) if sizes else None,
                "delay": float(np.median(delays)) if delays else None,
                "called": ", ".join(sorted(set(named))),
            }
        )  # fmt: skip
    print_table(rows, {k: k for k in rows[0]} | {"delay": "delay s"})
    return 0 if right >= 0.9 * args.seeds * len(FAULTS) else 1


if __name__ == "__main__":
    sys.exit(main())
