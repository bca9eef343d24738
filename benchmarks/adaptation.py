"""Wear is followed and faults are not learned: vehicles over 150 drives.

    python -m benchmarks.adaptation [--vehicles N] [--bases N] [--seed N]

Drives are drawn from simulated base drives, each simulated healthy, worn and with each fault at full size;
what changes slowly is that difference times its share of full size. Each drive has tolerances of its own: air
mass flow 0.3 %, pressure difference 0.03 kPa and 1 %. Changes begin at drive 30 and reach their size within
20 or 100 drives. Every line says how many vehicles it counts.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from ingest.simulators.parameters import Plant
from pipeline.adapting import Observer
from pipeline.fitting import fit
from pipeline.recipe import load_recipe
from stages.adapt import Settings, commission, follow
from stages.forget import forgotten
from stages.poison import Drives

Array = NDArray[np.float64]
CYCLES = ("udds", "us06", "hwfet", "ftp75", "wltc_3b")
DRIVES, BEGIN = 150, 30
P = Plant()
WORN = {
    "volumetric_efficiency": {k: getattr(P, k) * 0.95 for k in ("c_v0", "c_v1", "c_v2")},
    "restriction": {"A_Thr": P.A_Thr / np.sqrt(1.2)},
}
FAULTS = {
    "maf +5 %": ("maf_gain", 0.05), "maf -5 %": ("maf_gain", -0.05),
    "p_Int +2 %": ("intake_pressure_gain", 0.02), "p_Bst -2 %": ("boost_pressure_gain", -0.02),
    "boost leak 6 mm": ("boost_leak", 6.0), "intake leak 6 mm": ("intake_leak", 6.0),
}  # fmt: skip


def library(bases: int, seed: int) -> tuple[Observer, dict[str, tuple[Drives, Array]]]:
    """The observer, and of all base drives the region means, healthy and with each change."""

    def drive(k: int, **more: object):  # type: ignore[no-untyped-def]
        cycle = CYCLES[k % len(CYCLES)]
        return simulate_airpath(cycle=cycle, seed=seed + k, duration_s=900, name=f"d{k}", **more)  # type: ignore[arg-type]

    training = [
        simulate_airpath(cycle=c, seed=seed + 5000 + i) for i, c in enumerate(("wltc_3b", "ftp75", "us06"))
    ]
    calibration = [
        simulate_airpath(cycle=c, seed=seed + 6000 + i, name=f"c{i}") for i, c in enumerate(("udds", "hwfet"))
    ]
    observer = Observer.of(fit(training, load_recipe("diesel_airpath"), calibration))
    changes: dict[str, dict[str, object]] = {"healthy": {}}
    changes |= {name: {"overrides": worn} for name, worn in WORN.items()}
    for name, (fault, size) in FAULTS.items():
        changes[name] = {"faults": [Fault(name=fault, magnitude=size, onset_s=0.0)]}
    found = {}
    for name, more in changes.items():
        found[name] = observer.drives([observer.block(drive(k, **more)) for k in range(bases)])
        print(f"simulated {bases} drives: {name}", flush=True)
    return observer, found


def sizes(observer: Observer, found: dict[str, tuple[Drives, Array]]) -> dict[str, float]:
    """How large each full wear is in its own unit: what it changes in the residual, per unit of the wear. At
    small flows the pressure loss grows with the root of what it grows with at large ones."""
    healthy, unit = found["healthy"]
    out = {}
    for j, (name, residual) in enumerate((("volumetric_efficiency", 0), ("restriction", 1))):
        worn = found[name][0]
        weight = np.minimum(healthy.count[:, residual], worn.count[:, residual])
        x, y = unit[:, j, residual], (worn.mean - healthy.mean)[:, residual]
        out[name] = float((weight * x * y).sum() / (weight * x * x).sum())
    return out


def vehicle(
    found: dict[str, tuple[Drives, Array]], growth: dict[str, Array], rng: np.random.Generator
) -> tuple[Drives, Array]:
    """A vehicle's drives; ``growth`` (drives,) of each change, in full sizes."""
    healthy, wear = found["healthy"]
    pick = rng.integers(len(healthy), size=DRIVES)
    drives, shift = healthy.but(pick), wear[pick]
    mean = drives.mean.copy()
    for name, share in growth.items():
        full = found[name][0]
        both = (full.count[pick] > 0) & (drives.count > 0)
        mean += share[:, None, None] * np.where(both, full.mean[pick] - drives.mean, 0.0)
    gain, level, scale = rng.normal(size=(3, DRIVES)) * np.array([0.003, 0.03, 0.01])[:, None]
    maf = found["maf +5 %"][0]
    both = (maf.count[pick] > 0) & (drives.count > 0)
    mean += (gain / 0.05)[:, None, None] * np.where(both, maf.mean[pick] - drives.mean, 0.0)
    mean[:, 1] += level[:, None] + scale[:, None] * shift[:, 1, 1]
    return replace(drives, mean=mean), shift


def ramp(over: int) -> Array:
    return np.clip((np.arange(DRIVES) - BEGIN) / over, 0.0, (DRIVES - BEGIN) / 100 if over == 100 else 1.0)


def rows() -> dict[str, tuple[dict[str, Array], int]]:
    """What grows in each row, and in how many drives."""
    both = {"volumetric_efficiency": ramp(100), "restriction": ramp(100)}
    out = {"none": ({}, 100), **{name: ({name: ramp(100)}, 100) for name in WORN}, "both wears": (both, 100)}
    for name in FAULTS:
        for over in (20, 100):
            out[f"{name} over {over}"] = ({name: np.clip(ramp(over), 0, 1)}, over)
    return {**out, "both wears, maf +5 %": ({**both, "maf +5 %": np.clip(ramp(100), 0, 1)}, 100)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=40)
    parser.add_argument("--bases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=70000)
    args = parser.parse_args()
    observer, found = library(args.bases, args.seed)
    settings, names = Settings(), [n for n, _ in observer.directions]
    headings = ("change from drive 30", "alarms", "at share", "named", "set", "bias < 0.5 sd")
    full = sizes(observer, found)
    print("\nfull wear:", ", ".join(f"{name} {100 * x:.1f} %" for name, x in full.items()))
    print("\n{:32s}{:>9s}{:>10s}{:>9s}{:>9s}{:>15s}".format(*headings))
    n = args.vehicles
    for title, (growth, over) in rows().items():
        found_out = [
            one(observer, found, growth, over, args.seed + i, settings, names, full) for i in range(n)
        ]
        alarmed = [r["share"] for r in found_out if r["share"] is not None]
        share = f"{np.median(alarmed):.2f}" if alarmed else "-"
        named, both, unbiased = (sum(bool(r[k]) for r in found_out) for k in ("named", "set", "unbiased"))
        counts = [f"{x}/{n}" for x in (len(alarmed), named, both, unbiased)]
        print(
            f"{title:32s}{counts[0]:>9s}{share:>10s}{counts[1]:>9s}{counts[2]:>9s}{counts[3]:>15s}",
            flush=True,
        )
    learned = float(np.median([rls(found, args.seed + i) for i in range(n)]))
    print("\nrecursive least squares by region, forgetting 0.9, (6.1) as printed, maf +5 % over 20 drives:")
    print(f"  {100 * learned:.0f} % of the fault is learned 30 drives later (median of {n} vehicles)")


def one(observer, found, growth, over, seed, settings, names, full):  # type: ignore[no-untyped-def]
    """One vehicle: share of the change at its first alarm; whether named right ten drives later, whether the
    set {wear, maf} is shown in the end, and whether the wear is followed."""
    rng = np.random.default_rng(seed)
    drives, shift = vehicle(found, growth, rng)
    every = np.arange(DRIVES)
    state = commission(drives.but(every[:BEGIN]), observer.wears)
    _, seen = follow(state, drives.but(every[BEGIN:]), shift[BEGIN:], observer.wears, settings)
    first = next((i for i, s in enumerate(seen) if s.alarm), None)
    fault = next((FAULTS[n][0] for n in growth if n in FAULTS), None)
    later = seen[min(first + 10, len(seen) - 1)] if first is not None else None
    best = max(later.faults, key=lambda f: later.faults[f], default=None) if later else None
    truth = [growth.get(n, np.zeros(DRIVES))[-1] * full[n] for n in observer.detector.recipe.wear]
    off = [abs(w - t) for w, t in zip(seen[-1].wear, truth, strict=True)]
    scale = [0.0045, 0.048 / 1.5]  # a drive's own standard deviation, in units of the wear
    return {
        "share": None if first is None else first / over,
        "named": later is not None and any(names[f] == fault for f in later.faults),
        "set": any(names[f] == "maf_gain" for f in seen[-1].faults) and best is None,
        "unbiased": all(o < 0.5 * s for o, s in zip(off, scale, strict=True)),
    }


def rls(found: dict[str, tuple[Drives, Array]], seed: int) -> float:
    """How much of a fault the forgetting models have taken for normal."""
    drives, _ = vehicle(found, {"maf +5 %": np.clip(ramp(20), 0, 1)}, np.random.default_rng(seed))
    adapted = forgotten(drives.mean, drives.count, 0.9)
    at = BEGIN + 20 + 30
    seen = drives.count[at, 0] > 0
    level = float(np.average(drives.mean[at, 0][seen], weights=drives.count[at, 0][seen]))
    left = float(np.average((drives.mean[at] - adapted[at])[0][seen], weights=drives.count[at, 0][seen]))
    return 1 - left / level


if __name__ == "__main__":
    main()
