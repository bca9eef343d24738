"""Wear is followed and faults are not learned: vehicles over 150 drives.

    python -m benchmarks.adaptation [--vehicles N] [--bases N] [--seed N]

Drives are drawn from simulated base drives, each simulated healthy, worn and with each fault at full size;
what changes slowly is that difference times its share of full size. Each drive has tolerances of its own: air
mass flow 0.3 %, pressure difference 0.03 kPa and 1 %. Changes begin at drive 30 and reach their size within
20 or 100 drives; in time is an alarm before that. The witness (:mod:`stages.witness`) was fitted on further
drives. Last come vehicles with a fault that grows within 200 s of one drive. Every line says how many it
counts.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from ingest.simulators.parameters import Plant
from pipeline.adapting import Observer
from pipeline.fitting import fit
from pipeline.recipe import load_recipe
from stages.adapt import Seen, Settings, commission, follow
from stages.forget import forgotten
from stages.poison import Drives, inverse, spread_of
from stages.stage import columns
from stages.witness import LIMIT, Sworn, contradiction, swear_in

Array = NDArray[np.float64]
Changes = dict[str, tuple[Drives, Array, Array]]  # region means, shifts of wears, what a witness is left
CYCLES = ("udds", "us06", "hwfet", "ftp75", "wltc_3b")
DRIVES, BEGIN = 150, 30
WITNESSED = 15  # drives
WITHIN = " within 200 s"
LATE = "maf -5 % over 20"  # looks like wear at first: has time until 10 drives after its full size
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


def library(bases: int, seed: int) -> tuple[Observer, Sworn, Changes]:
    """Observer, witness, and what they see of all base drives, healthy and with each change."""

    def drive(k: int, **more: object):  # type: ignore[no-untyped-def]
        cycle = CYCLES[k % len(CYCLES)]
        return simulate_airpath(cycle=cycle, seed=seed + k, duration_s=900, name=f"d{k}", **more)  # type: ignore[arg-type]

    training = [
        simulate_airpath(cycle=c, seed=seed + 5000 + i) for i, c in enumerate(("wltc_3b", "ftp75", "us06"))
    ]
    calibration = [
        simulate_airpath(cycle=c, seed=seed + 6000 + i, name=f"c{i}") for i, c in enumerate(("udds", "hwfet"))
    ]
    recipe = load_recipe("diesel_airpath")
    observer = Observer.of(fit(training, recipe, calibration))
    assert recipe.witness is not None
    sworn = swear_in(recipe.witness, [columns(observer.block(drive(7000 + k))) for k in range(WITNESSED)])
    assert sworn is not None
    changes: dict[str, dict[str, object]] = {"healthy": {}}
    changes |= {name: {"overrides": worn} for name, worn in WORN.items()}
    for name, (fault, size) in FAULTS.items():
        changes[name] = {"faults": [Fault(name=fault, magnitude=size, onset_s=0.0)]}
        within = Fault(name=fault, magnitude=size, onset_s=300.0, ramp_s=200.0)
        changes[name + WITHIN] = {"faults": [within]}
    found = {}
    for name, more in changes.items():
        blocks = [observer.block(drive(k, **more)) for k in range(bases)]
        found[name] = (*observer.drives(blocks), np.array([sworn.mean(columns(b)) for b in blocks]))
    print(f"simulated {bases * len(changes)} drives", flush=True)
    return observer, sworn, found


def sizes(observer: Observer, found: Changes) -> dict[str, float]:
    """How large each full wear is in its own unit: what fits best to its change of the residuals, by the
    observer's weights in the end. At small flows the pressure loss grows less than at large ones, so it is
    not one number."""
    healthy, unit, _ = found["healthy"]
    spread = spread_of(vehicle(found, {}, np.random.default_rng(0))[0], np.arange(BEGIN))
    out = {}
    for j, (name, wear) in enumerate(observer.detector.recipe.wear.items()):
        worn, size = found[name][0], wear.per_100
        count = np.where(worn.count > 0, healthy.count, 0.0)
        y = np.where(count > 0, worn.mean - healthy.mean, 0.0)
        for _ in range(6):  # the weights go with the size
            gained = known = 0.0
            for k in range(len(healthy)):
                wrong = Settings().memory * (wear.inexact * ramp(100)[-1] * size * unit[k, j]) ** 2
                V, S = inverse(count[k], healthy.noise, spread, wrong, 1.0), unit[k, j].ravel()
                gained, known = gained + S @ V @ y[k].ravel(), known + S @ V @ S
            size = float(gained / known)
        out[name] = size
    return out


def vehicle(
    found: Changes, growth: dict[str, Array], rng: np.random.Generator
) -> tuple[Drives, Array, Array]:
    """A vehicle's drives; ``growth`` (drives,) of each change, in full sizes. Regions that a changed drive
    does not visit count nothing while there is some of that change."""
    healthy, wear, silent = found["healthy"]
    pick = rng.integers(len(healthy), size=DRIVES)
    drives, shift, left = healthy.but(pick), wear[pick], silent[pick]
    mean, count = drives.mean.copy(), drives.count.copy()
    for name, share in growth.items():
        full, _, said = found[name]
        left = left + share * (said[pick] - silent[pick])
        both = (full.count[pick] > 0) & (drives.count > 0)
        mean += share[:, None, None] * np.where(both, full.mean[pick] - drives.mean, 0.0)
        count[(share > 0)[:, None, None] & ~both] = 0.0
    gain, level, scale = rng.normal(size=(3, DRIVES)) * np.array([0.003, 0.03, 0.01])[:, None]
    maf = found["maf +5 %"][0]
    both = (maf.count[pick] > 0) & (drives.count > 0)
    mean += (gain / 0.05)[:, None, None] * np.where(both, maf.mean[pick] - drives.mean, 0.0)
    mean[:, 1] += level[:, None] + scale[:, None] * shift[:, 1, 1]
    return replace(drives, mean=mean, count=count), shift, left


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
    observer, sworn, found = library(args.bases, args.seed)
    full = sizes(observer, found)
    print("\nfull wear:", ", ".join(f"{name} {100 * x:.1f} %" for name, x in full.items()))
    print(f"the witness: sd {100 * sworn.sd:.2f} % between drives, full wear adds " + ", ".join(
        f"{100 * np.mean(found[name][2] - found['healthy'][2]):.2f} %" for name in WORN))  # fmt: skip
    headings = ("change from drive 30", "alarms", "in time", "at share", "named", "set", "denied", "followed")
    print("\n{:32s}{:>9s}{:>9s}{:>10s}{:>9s}{:>9s}{:>9s}{:>10s}".format(*headings))
    n = args.vehicles
    for title, (growth, over) in rows().items():
        told = [Told.of(observer, sworn, found, growth, over, args.seed + i, full) for i in range(n)]
        shares = [t.share for t in told if t.share is not None]
        share = f"{np.median(shares):.2f}" if shares else "-"
        in_time = sum(x <= (1.5 if title == LATE else 1.0) for x in shares)
        named, both, denied, followed = (
            sum(getattr(t, k) for t in told) for k in ("named", "together", "denied", "followed")
        )
        counts = [f"{x}/{n}" for x in (len(shares), in_time, named, both, denied, followed)]
        print(f"{title:32s}{counts[0]:>9s}{counts[1]:>9s}{share:>10s}"
              + "{:>9s}{:>9s}{:>9s}{:>10s}".format(*counts[2:]), flush=True)  # fmt: skip
    taken = [learned_within(observer, found, name, args.seed + i, full) for name in FAULTS for i in range(n)]
    print(f"\na fault that grows within 200 s of drive 80: that drive is learned from in "
          f"{sum(k for k, _ in taken)}/{len(taken)}; "
          f"the wears change by at most {100 * max(x for _, x in taken):.2f} % of full")  # fmt: skip
    learned = float(np.median([rls(found, args.seed + i) for i in range(n)]))
    print("\nrecursive least squares by region, forgetting 0.9, (6.1) as printed, maf +5 % over 20 drives:")
    print(f"  {100 * learned:.0f} % of the fault is learned 30 drives later (median of {n} vehicles)")


@dataclass(frozen=True, kw_only=True)
class Told:
    """What is said of one vehicle: the share of the change's drives at its first alarm; whether the fault is
    in the set ten drives later; whether the set {wear, maf} is shown in the end, without an alarm; whether
    the witness denies the wear in the end; whether the wear is followed within half a drive's sigma."""

    share: float | None
    named: bool
    together: bool
    denied: bool
    followed: bool

    @classmethod
    def of(
        cls, observer: Observer, sworn: Sworn, found: Changes, growth: dict[str, Array], over: int, seed: int,
        full: dict[str, float],
    ) -> Told:  # fmt: skip
        names = [n for n, _ in observer.directions]
        drives, shift, left = vehicle(found, growth, np.random.default_rng(seed))
        seen = followed(observer, drives, shift)
        first = next((i for i, s in enumerate(seen) if s.alarm), None)
        fault = next((FAULTS[n][0] for n in growth if n in FAULTS), None)
        later = seen[min(first + 10, len(seen) - 1)] if first is not None else None
        truth = [growth.get(n, np.zeros(DRIVES))[-1] * full[n] for n in observer.detector.recipe.wear]
        scale = [0.0045, 0.048 / 1.5]  # a drive's own standard deviation, in units of the wear
        adds = [sworn.witness.wear[n] for n in observer.detector.recipe.wear]
        z = contradiction(
            left[BEGIN:] - left[:BEGIN].mean(), np.array([s.wear for s in seen]) @ adds, sworn.sd, BEGIN,
            sworn.witness.inexact,
        )  # fmt: skip
        return cls(
            share=None if first is None else first / over,
            named=later is not None and any(names[f] == fault for f in later.faults),
            together=first is None and any(names[f] == "maf_gain" for f in seen[-1].faults),
            denied=bool(z[-1] > LIMIT),
            followed=all(abs(w - t) < 0.5 * s for w, t, s in zip(seen[-1].wear, truth, scale, strict=True)),
        )


def followed(observer: Observer, drives: Drives, shift: Array) -> list[Seen]:
    """A vehicle's drives after its commissioning."""
    every = np.arange(DRIVES)
    state = commission(drives.but(every[:BEGIN]), shift[:BEGIN], observer.wears)
    return follow(state, drives.but(every[BEGIN:]), shift[BEGIN:], observer.wears, Settings())[1]


def learned_within(
    observer: Observer, found: Changes, name: str, seed: int, full: dict[str, float]
) -> tuple[bool, float]:
    """Whether a drive in which a fault grows was learned from, and how far it moved the wears, of full."""
    at = 80  # drive
    drives, shift, _ = vehicle(
        found, {name + WITHIN: (np.arange(DRIVES) == at).astype(float)}, np.random.default_rng(seed)
    )
    seen = followed(observer, drives, shift)
    before, after = seen[at - BEGIN - 1], seen[at - BEGIN]
    moved = np.abs(np.subtract(after.wear, before.wear)) / [full[n] for n in observer.detector.recipe.wear]
    return after.learned, float(moved.max())


def rls(found: Changes, seed: int) -> float:
    """How much of a fault the forgetting models have taken for normal."""
    drives, _, _ = vehicle(found, {"maf +5 %": np.clip(ramp(20), 0, 1)}, np.random.default_rng(seed))
    adapted = forgotten(drives.mean, drives.count, 0.9)
    at = BEGIN + 20 + 30
    seen = drives.count[at, 0] > 0
    level = float(np.average(drives.mean[at, 0][seen], weights=drives.count[at, 0][seen]))
    left = float(np.average((drives.mean[at] - adapted[at])[0][seen], weights=drives.count[at, 0][seen]))
    return 1 - left / level


if __name__ == "__main__":
    main()
