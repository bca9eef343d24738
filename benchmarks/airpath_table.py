"""The dissertation's way to isolate, Table 5.2, beside undoing hypotheses.

    python -m benchmarks.airpath_table [--seeds N] [--folder FOLDER]

The recipe `diesel_airpath`, its relations and its gate are the same for both. Table 5.2 judges the residuals
of (5.41): which of them have a mean off zero (:mod:`stages.detect`, thresholds from the same calibration
logs); whether the third goes with the flow (F1) or with what a hole lets through (F4), for which the
dissertation compares distributions; and whether f_Thr is asked beyond where it was trained (F2, F3), its
comparison of operating regimes. As the flow in front of the throttle is the measured one, F5 moves the last
two residuals alone; the printed table has all three.

Trained on one WLTC, without tolerances, drives not tuned on. With FOLDER, also the petrol engine's logs of
:mod:`benchmarks.liu_bench`: a throttle that is active, and no boost leak.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.airpath import CALIBRATION, LARGE, LENGTH_S
from benchmarks.liu_bench import read_logs, table
from ingest.log import Log
from ingest.simulators.airpath import Fault, simulate_airpath
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.fitting import fit
from pipeline.recipe import Recipe, build_recipe, load_recipe

FIRST_SEED = 9800
UNEXPECTED = "max(`f_Thr.novelty` - 1, 0)"  # how far the throttle's relation is from its training
TABLE = {
    "maf_gain": {"W_LeakBst": "x", "dW_Cyl": "x"},
    "boost_pressure_gain": {"W_LeakBst": "x", "W_LeakInt": "x", "unexpected": "+"},
    "intake_pressure_gain": {"W_LeakBst": "x", "W_LeakInt": "x", "dW_Cyl": "x", "unexpected": "+"},
    "boost_leak": {"W_LeakBst": "+", "dW_Cyl": "+"},
    "intake_leak": {"W_LeakInt": "+", "dW_Cyl": "+"},
}
SHAPES = {
    "maf_gain": {"dW_Cyl": "W_HFM"},
    "boost_leak": {"dW_Cyl": "leak_flow(1, p_Bst, T_Bst, p_Amb)"},
}
THROTTLED = {  # air is sucked in behind the throttle, to pressures that it was never trained for
    **{f: TABLE[f] for f in ("maf_gain", "boost_pressure_gain", "intake_pressure_gain")},
    "intake_leak": {"W_LeakInt": "-", "dW_Cyl": "-", "unexpected": "+"},
}


def with_table(
    recipe: Recipe, residuals: Mapping[str, str], faults: Mapping[str, Any], shapes: Any
) -> Recipe:
    """A recipe that judges ``residuals`` by a table instead of undoing hypotheses."""
    definition = recipe.to_json()
    kept = [s for s in definition["stage"] if s["use"] not in ("isolate", "pairs", "sensors")]
    kept[-1] = {"use": "residuals", "residuals": dict(residuals)}
    judging = [{"use": "detect"}, {"use": "signatures", "table": dict(faults), "shapes": dict(shapes)}]
    return build_recipe(f"{recipe.name}_table", {**definition, "stage": [*kept, *judging]})


def diesel() -> Recipe:
    recipe = load_recipe("diesel_airpath")
    known = next(s for s in recipe.to_json()["stage"] if s["use"] == "residuals")["residuals"]
    residuals = {r: known[r] for r in ("W_LeakBst", "W_LeakInt", "dW_Cyl")}
    return with_table(recipe, {**residuals, "unexpected": UNEXPECTED}, TABLE, SHAPES)


def throttled() -> Recipe:
    """Of the petrol engine: flows by its relations for throttle and cylinders."""
    throttle, cylinders = "exp(f_thr) * p_Bst / sqrt(T_Bst / 298)", "exp(f_cyl) * p_Int * n_Eng"
    residuals = {
        "W_LeakBst": f"W_HFM - {throttle}",
        "W_LeakInt": f"{throttle} - {cylinders}",
        "dW_Cyl": f"W_HFM - {cylinders}",
        "unexpected": UNEXPECTED.replace("f_Thr", "f_thr"),
    }
    return with_table(load_recipe("si_airpath"), residuals, THROTTLED, {})


def drives(seeds: int) -> list[tuple[str, float, Log]]:
    """Fault-free ones first."""
    found = [
        ("none", 0.0, simulate_airpath(cycle=cycle, seed=FIRST_SEED + i))
        for cycle in LENGTH_S
        for i in range(4 * seeds)
    ]
    for cycle, length in LENGTH_S.items():
        for fault, sizes in LARGE.items():
            for k, size in enumerate(sizes):
                for seed in range(FIRST_SEED + 50 * (k + 1), FIRST_SEED + 50 * (k + 1) + seeds):
                    injected = [Fault(name=fault, magnitude=size, onset_s=length / 3)]
                    found.append((fault, size, simulate_airpath(cycle=cycle, seed=seed, faults=injected)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="per cycle, fault and size")
    parser.add_argument("--folder", type=Path, help="of the petrol engine's logs")
    args = parser.parse_args()
    if args.folder:
        logs = read_logs(args.folder)
        for title, recipe in (("Table 5.2", throttled()), ("undoing hypotheses", load_recipe("si_airpath"))):
            table(title, fit([logs["NF"]], recipe), logs, official=False)
    calibration = [simulate_airpath(cycle=c, seed=s, name=f"{c}_{s}") for c, s in CALIBRATION]
    training = [simulate_airpath(seed=0)]
    ways = {"Table 5.2": diesel(), "undoing hypotheses": load_recipe("diesel_airpath")}
    detectors = {title: fit(training, recipe, calibration) for title, recipe in ways.items()}
    some = drives(args.seeds)
    for title, detector in detectors.items():
        shown(title, detector, some)


def shown(title: str, detector: Detector, some: list[tuple[str, float, Log]]) -> None:
    print(f"\n{title}\n{'fault':24s}{'size':>8s}{'drives':>8s}{'alarms':>8s}{'right':>8s}  called")
    said = [(fault, size, diagnose(log, detector).verdict.fault) for fault, size, log in some]
    for fault, size in dict.fromkeys((f, s) for f, s, _ in said):
        names = [name for f, s, name in said if (f, s) == (fault, size)]
        alarms = sum(name not in ("none", "insufficient_evidence") for name in names)
        others = {n: names.count(n) for n in sorted({*names} - {fault, "none"})}
        called = ", ".join(f"{n} {count}" for n, count in others.items())
        print(f"{fault:24s}{size:8g}{len(names):8d}{alarms:8d}{names.count(fault):8d}  {called}")


if __name__ == "__main__":
    main()
