"""Air-path diagnosis on simulated drives.

    python -m benchmarks.airpath [single] [tolerance] [drift] [ends] [intermittent] [egr] [egr_without]
        [egr_tolerance] [pairs] [sensors] [--seeds N]

Trained on one WLTC, calibrated on other cycles, tested on UDDS, US06 and HWFET with seeds from 9000, that
nothing was tuned on. Every line says how many drives it counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, product

import numpy as np

from ingest.log import Log
from ingest.simulators.airpath import Fault, simulate_airpath
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.fitting import fit
from pipeline.recipe import load_recipe
from stages.results import PAIR

Sizes = Mapping[str, Sequence[float]]  # by fault
LENGTH_S = {"udds": 1369.0, "us06": 596.0, "hwfet": 765.0}
FIRST_SEED = 9000
CALIBRATION = [
    ("ftp75", 1),
    ("nedc", 2),
    ("wltc_3b", 3),
    ("ftp75", 4),
    ("us06", 5),
    ("hwfet", 6),
    ("udds", 7),
]
SMALL = {
    "maf_gain": (-0.05, -0.02, 0.02, 0.05, 0.1),
    "boost_pressure_gain": (-0.02, -0.005, 0.005, 0.02),
    "intake_pressure_gain": (-0.02, -0.005, 0.005, 0.02),
    "boost_leak": (6.0, 8.0),
    "intake_leak": (6.0, 8.0),
}
LARGE = {
    "maf_gain": (-0.05, 0.05),
    "boost_pressure_gain": (-0.02, 0.02),
    "intake_pressure_gain": (-0.02, 0.02),
    "boost_leak": (6.0, 8.0),
    "intake_leak": (6.0, 8.0),
}
PAIRED = {"maf_gain": 0.06, "boost_pressure_gain": 0.04, "intake_pressure_gain": 0.04}  # either sign
LEAKS = {"boost_leak": 8.0, "intake_leak": 8.0}
SENSORS = {  # magnitudes, and of an offset its sign's size by sensor
    "sensor_stuck": (0.0,),
    "sensor_noise": (1.0,),
    "sensor_offset": (-1.0, 1.0),
}
SCATTER = {"W_HFM": 0.1, "p_Bst": 0.02, "p_Int": 0.02, "T_Int": 0.01}  # relative
OFFSET = {"W_HFM": 4.0, "p_Bst": 3.0, "p_Int": 3.0, "T_Int": 12.0}  # g/s, kPa, K
EGR = {**LARGE, "intake_temperature_gain": (-0.03, 0.03), "egr_stuck_open": (15.0, 30.0, 60.0)}


@dataclass(frozen=True)
class Case:
    """One drive: what is wrong with it and what the verdict on it was."""

    cycle: str = ""
    seed: int = 0
    tolerance: int = 0
    egr: bool = False
    exhaust: bool = True  # whether p_Exh is logged
    fault: str = "none"  # two joined by "+", then also two magnitudes
    magnitude: float = 0.0
    second: float = 0.0
    signal: str | None = None  # of the faults that any sensor can have
    ramp_s: float = 0.0
    end: float | None = None  # share of the drive
    burst_s: float | None = None  # the fault comes for as long, and stays away for as long

    @property
    def name(self) -> str:
        return f"{self.cycle}_{self.seed}"


@dataclass(frozen=True)
class Found:
    case: Case
    fault: str
    signal: str | None
    p: float
    candidates: tuple[str, ...]  # the set, and what would look like the fault that is named
    delay_s: float
    size: float
    cleared_s: float
    names: tuple[str, ...]  # of all alarms

    @property
    def alarm(self) -> bool:
        return self.fault not in ("none", "insufficient_evidence")

    @property
    def right(self) -> bool:
        return self.fault == self.case.fault and self.case.signal in (None, self.signal)

    @property
    def included(self) -> bool:
        """The true fault, or both of two, in the reported set."""
        return self.case.fault in self.candidates or {*self.case.fault.split(PAIR)} <= {*self.candidates}


def logged(log: Log, exhaust: bool) -> Log:
    """The log, without the exhaust pressure where that is not to be logged."""
    if exhaust:
        return log
    groups = {
        k: replace(
            g,
            frame=g.frame.drop("p_Exh", strict=False),
            signals={n: s for n, s in g.signals.items() if n != "p_Exh"},
        )
        for k, g in log.groups.items()
    }
    return replace(log, groups=groups)


@cache
def detector(tolerance: int, egr: bool, exhaust: bool) -> Detector:
    """Training without tolerances, with EGR on a second WLTC; calibration with tolerances."""
    calibrate = [
        simulate_airpath(cycle=c, seed=s, tolerance=tolerance, egr=egr, name=f"{c}_{s}")
        for c, s in CALIBRATION
    ]
    training = [simulate_airpath(seed=s, egr=e) for s, e in ((0, False), (100, True))[: 1 + egr]]
    learned, checked = ([logged(log, exhaust) for log in logs] for logs in (training, calibrate))
    return fit(learned, load_recipe("diesel_airpath"), checked)


def judged(case: Case) -> Found:
    """The verdict on a drive."""
    length, onset = LENGTH_S[case.cycle], LENGTH_S[case.cycle] / 3
    end = None if case.end is None else case.end * length
    times = [(onset, end)]
    if case.burst_s is not None:
        times = [(t, t + case.burst_s) for t in np.arange(onset, length - case.burst_s, 2 * case.burst_s)]
    faults = [
        Fault(name=name, magnitude=size, onset_s=t0, ramp_s=case.ramp_s, end_s=t1, signal=case.signal)
        for name, size in zip(case.fault.split(PAIR), (case.magnitude, case.second), strict=False)
        for t0, t1 in times
        if name != "none"
    ]
    log = simulate_airpath(
        cycle=case.cycle, seed=case.seed, tolerance=case.tolerance, egr=case.egr, faults=faults
    )
    diagnosis = diagnose(logged(log, case.exhaust), detector(case.tolerance, case.egr, case.exhaust))
    verdict, samples = diagnosis.verdict, diagnosis.samples
    on = samples.filter(samples["detection"] == 1)["time"]
    last = float(on[-1]) if len(on) else np.nan
    return Found(
        case=case,
        fault=verdict.fault,
        signal=verdict.signal,
        p=verdict.probability.get(verdict.fault, 0.0),
        candidates=(*verdict.set, *verdict.statistics.get("same_as", ())),
        delay_s=np.nan if verdict.detected_s is None else verdict.detected_s - onset,
        size=np.nan if verdict.magnitude is None else verdict.magnitude.value,
        cleared_s=np.nan if end is None else last - end,
        names=tuple(e.kind for e in verdict.events),
    )


def drives(plan: Case, sizes: Sizes, seeds: int) -> Iterator[Case]:
    """As ``plan``, on every cycle: fault-free drives, four for every one of a fault's, and all faults."""
    for cycle in LENGTH_S:
        for seed in range(FIRST_SEED, FIRST_SEED + 4 * seeds):
            yield replace(plan, cycle=cycle, seed=seed)
        for fault, magnitudes in sizes.items():
            for i, m in enumerate(magnitudes):
                for seed in range(FIRST_SEED + 100 * (i + 1), FIRST_SEED + 100 * (i + 1) + seeds):
                    yield replace(plan, cycle=cycle, seed=seed, fault=fault, magnitude=m)


def pairs(plan: Case, seeds: int) -> Iterator[Case]:
    """Every sensor with every other and with every leak, both signs, on the cycles that leave both 300 s."""
    sensors = [(f, s * m) for f, m in PAIRED.items() for s in (-1, 1)]
    two = [(a, b) for a, b in combinations([*sensors, *LEAKS.items()], 2) if a[0] in PAIRED and a[0] != b[0]]
    for cycle in LENGTH_S:
        for i, ((a, x), (b, y)) in enumerate(two):
            first, second = sorted(((a, x), (b, y)))
            for seed in range(FIRST_SEED + 50 * i, FIRST_SEED + 50 * i + seeds):
                name = PAIR.join((first[0], second[0]))
                yield replace(plan, cycle=cycle, seed=seed, fault=name, magnitude=first[1], second=second[1])


def sensors(plan: Case, seeds: int) -> Iterator[Case]:
    """Every sensor failing in every other way, on every cycle."""
    for cycle in LENGTH_S:
        for i, (signal, (fault, magnitudes)) in enumerate(product(OFFSET, SENSORS.items())):
            unit = {"sensor_noise": SCATTER, "sensor_offset": OFFSET}.get(fault, {}).get(signal, 1.0)
            for k, m in enumerate(magnitudes):
                for seed in range(FIRST_SEED + 40 * (2 * i + k), FIRST_SEED + 40 * (2 * i + k) + seeds):
                    yield replace(
                        plan, cycle=cycle, seed=seed, fault=fault, signal=signal, magnitude=m * unit
                    )


def report(title: str, found: Sequence[Found]) -> None:
    """False alarms, and by fault: detected, named right, in the set, confidently wrong, delay, size."""
    healthy = [f for f in found if f.case.fault == "none"]
    faulty = [f for f in found if f.case.fault != "none"]
    print(f"\n{title}")
    alarms = [f for f in healthy if f.alarm]
    names = ", ".join(f"{f.case.name} {f.fault}" for f in alarms)
    print(f"  fault-free drives with an alarm: {len(alarms)} of {len(healthy)} {names}")
    print(
        "  fault                                         size  drives  found  right  in set  p>.95 wrong"
        "   delay s: median, 90 %      size"
    )
    keys = sorted({(f.case.fault, f.case.signal or "", f.case.magnitude) for f in faulty})
    for fault, signal, size in keys:
        some = [
            f
            for f in faulty
            if (f.case.fault, f.case.signal or "", f.case.magnitude) == (fault, signal, size)
        ]
        _row(f"{fault} {signal}", f"{size:g}", some)
    _row("all", "", faulty)


def _row(name: str, size: str, some: Sequence[Found]) -> None:
    hit = [f for f in some if f.alarm and f.delay_s > -1]
    delays = np.array([f.delay_s for f in hit] or [np.nan])
    sizes = np.array([f.size for f in some if f.right] or [np.nan])
    print(
        f"  {name:42s}{size:>8s}{len(some):8d}{len(hit):7d}{sum(f.right for f in some):7d}"
        f"{sum(f.included for f in some):8d}"
        f"{sum(f.alarm and not f.right and not f.included and f.p > 0.95 for f in some):13d}"
        f"{np.median(delays):16.1f}{np.quantile(delays, 0.9):8.1f}{np.median(sizes):10.3g}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help="see above; all of them by default")
    parser.add_argument("--seeds", type=int, default=6, help="per cycle, fault and size")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    few = max(1, args.seeds // 3)
    plans: dict[str, tuple[str, Case, Sizes, int]] = {
        "single": ("no tolerances", Case(), SMALL, args.seeds),
        "tolerance": ("tolerance level 1", Case(tolerance=1), LARGE, args.seeds),
        "drift": ("drifts over 200 s", Case(ramp_s=200.0), LARGE, few),
        "ends": ("faults that end at 60 %", Case(end=0.6), LARGE, few),
        "intermittent": ("faults of a minute, a minute apart", Case(burst_s=60.0), LARGE, few),
        "egr": ("EGR active", Case(egr=True), EGR, args.seeds),
        "egr_without": ("EGR active, no p_Exh", Case(egr=True, exhaust=False), EGR, args.seeds),
        "egr_tolerance": ("EGR active, tolerance level 1", Case(egr=True, tolerance=1), EGR, args.seeds),
        "pairs": ("two faults at once", Case(), {}, few),
        "sensors": ("sensors that fail in other ways", Case(), {}, few),
    }
    if unknown := set(args.parts) - plans.keys():
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(plans)}")
    with ProcessPoolExecutor(args.workers) as pool:
        for part in args.parts or plans:
            title, plan, sizes, seeds = plans[part]
            others = {"pairs": pairs, "sensors": sensors}
            cases = others[part](plan, seeds) if part in others else drives(plan, sizes, seeds)
            found = list(pool.map(judged, cases, chunksize=4))
            report(title, found)
            if part == "ends":
                _cleared(found)
            if part == "intermittent":
                _kept(found)


def _cleared(found: Sequence[Found]) -> None:
    for fault in LARGE:
        late = np.array([f.cleared_s for f in found if f.case.fault == fault])
        late = late[np.isfinite(late)]
        print(f"  {fault}: cleared after {np.median(late):.0f} s (median), {late.max():.0f} s at most")


def _kept(found: Sequence[Found]) -> None:
    faulty = [f for f in found if f.case.fault != "none"]
    one = sum(set(f.names) == {f.case.fault} for f in faulty)
    alarms = [name == f.case.fault for f in faulty for name in f.names]
    print(
        f"  one name, the right one, in {one} of {len(faulty)} drives; {sum(alarms)} of {len(alarms)} alarms"
    )


if __name__ == "__main__":
    main()
