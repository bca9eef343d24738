"""Accommodation of isolated sensors on simulated drives: how much nearer the corrected reading is.

    python -m benchmarks.airpath_accommodation [--seeds N]

Gains of 5 and 10 % of either sign on UDDS, US06 and HWFET, as in :mod:`benchmarks.airpath`. From the first
correction to the end of the log, the root mean square difference from what the healthy sensor would have read
(the simulator writes it as truth: same noise, same lag), raw over corrected.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.airpath import LENGTH_S, detector
from ingest.simulators.airpath import Fault, simulate_airpath
from pipeline.diagnosing import diagnose

FIRST_SEED = 9700
SENSORS = {"maf_gain": "W_HFM", "boost_pressure_gain": "p_Bst", "intake_pressure_gain": "p_Int"}
SIZES = (-0.1, -0.05, 0.05, 0.1)
TARGET = 5.0


def ratio(cycle: str, seed: int, fault: str, size: float) -> float:
    """How much farther off the raw reading is than the corrected one; NaN where nothing was corrected."""
    signal = SENSORS[fault]
    faults = [Fault(name=fault, magnitude=size, onset_s=LENGTH_S[cycle] / 3)]
    log = simulate_airpath(cycle=cycle, seed=seed, faults=faults)
    group = diagnose(log, detector(0, False, True)).signals
    if group is None or signal + ".corrected" not in group.signals:
        return float("nan")
    truth = log.values(f"truth.{signal}")
    at = np.searchsorted(group.time, log.group_of(f"truth.{signal}").time - 1e-6)  # written less often
    raw, corrected = (group.frame[signal + kind].to_numpy()[at] for kind in ("", ".corrected"))
    since = int(np.flatnonzero(raw != corrected)[0])
    off, left = (np.sqrt(np.nanmean((x - truth)[since:] ** 2)) for x in (raw, corrected))
    return float(off / left)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="per cycle, fault and size")
    args = parser.parse_args()
    print(f"fault                  size  drives  at least {TARGET:g} x   median   least")
    for fault in SENSORS:
        for k, size in enumerate(SIZES):
            seeds = range(FIRST_SEED + 10 * k, FIRST_SEED + 10 * k + args.seeds)
            x = np.array([ratio(cycle, seed, fault, size) for cycle in LENGTH_S for seed in seeds])
            good = int((x >= TARGET).sum())
            print(f"{fault:22s}{size:5g}{len(x):8d}{good:14d}{np.nanmedian(x):9.1f}{np.nanmin(x):8.1f}")


if __name__ == "__main__":
    main()
