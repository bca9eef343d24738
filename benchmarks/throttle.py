"""Linear sensor monitoring: every figure that the method promises, measured, with the target beside it.

    python benchmarks/throttle.py                       # all parts, 20 seeds: an hour
    python benchmarks/throttle.py --part 1 --seeds 5    # and parts 2 and 4, which share its runs

Part 5 compares with what can be imported: `pip install --target others nfoursid sippy_unipi` and
PYTHONPATH=others.
Part 6 wants --slycot slycot-0.7.1.tar.gz, from `pip download --no-deps --no-binary slycot slycot`.
Seeds start at 9100; none from there on was used while building. One thread of linear algebra.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: threads cost more than they give here

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path = [str(HERE.parent), *(p for p in sys.path if Path(p).resolve() != HERE)]  # `ingest` is the package

from benchmarks.hair_dryer import compare
from benchmarks.throttle_printed import printed
from benchmarks.throttle_robustness import robustness
from benchmarks.throttle_runs import FAULTS, ONSET, RAMP, STAGES, Row, Run, monitored, simulate
from benchmarks.throttle_speed import end_to_end, identification
from ingest.simulators.throttle import Throttle, plant_coefficients
from stages.monitor import Monitor

FIRST_SEED = 9100
SHARE = 0.92775  # of the back e.m.f. in a_2


def parts_1_2_4(seeds: Sequence[int]) -> list[Row]:
    """Confusion, efficiency and compensation share their runs."""
    runs = {
        fault: [monitored(simulate(changes, s), fault) for s in seeds] for fault, changes in FAULTS.items()
    }
    return [*_confusion(runs), *_efficiency(runs), *_compensation(runs)]


def _confusion(runs: Mapping[str, Sequence[Run]]) -> list[Row]:
    rows, right, total = [], 0, 0
    for fault, group in runs.items():
        named = [r.named for r in group]
        # a fault-free log is right without any alarm
        good = [r.named == fault and (fault != "none" or not (r.frame["detection"] > 0).any()) for r in group]
        right, total = right + sum(good), total + len(good)
        counts = ", ".join(f"{n} {named.count(n)}" for n in sorted(set(named)))
        rows.append(Row(part=1, what=f"{fault}: called", measured=counts, target=f"{fault} {len(group)}"))
    rows.append(
        Row(part=1, what="right", measured=f"{right}/{total}", target=">= 99 %", holds=right >= 0.99 * total)
    )
    alarms = sum(int(r.frame["detection"].sum()) for r in runs["none"])
    early = sum(r.early for group in runs.values() for r in group)
    windows = len(runs["none"]) * 50 + sum(len(g) for f, g in runs.items() if f != "none") * int(ONSET)
    rate = 100.0 * (alarms + early) / windows
    rows.append(
        Row(
            part=1,
            what="false alarms per fault-free window",
            measured=f"{rate:.2f} %",
            target="<= 0.3 %",
            holds=rate <= 0.3,
        )
    )
    delays = {
        f: [r.delay for r in g if r.named == f and r.delay is not None]
        for f, g in runs.items()
        if f != "none"
    }
    for fault, values in delays.items():
        limit = 7.0 if fault == "tps_time_constant" else 3.5
        median = float(np.median(values))
        rows.append(
            Row(
                part=1,
                what=f"{fault}: delay, median (max)",
                measured=f"{median:.1f} ({max(values):.0f}) s",
                target=f"<= {limit} (12) s",
                holds=median <= limit and max(values) <= 12.0,
            )
        )
    return rows


def _truth(fault: str) -> dict[str, float]:
    """ln of each affected indicator over its healthy value, averaged over the last five windows."""
    (name, m), *_ = FAULTS[fault] or (("none", 0.0),)
    size = m * (np.arange(45.0, 50.0, 0.01) - ONSET) / RAMP
    own, share = float(np.mean(np.log1p(size))), float(np.mean(np.log1p(SHARE * size)))
    return {
        "none": {}, "tps_time_constant": {"tau_tps": own}, "tps_gain": {"k_tps": own},
        "motor_torque_constant": {"k_et": own, "a2": share}, "back_emf_constant": {"a2": share},
    }[name]  # fmt: skip


def _efficiency(runs: Mapping[str, Sequence[Run]]) -> list[Row]:
    monitor = next(s for s in STAGES if isinstance(s, Monitor))
    rows = []
    k, *a = plant_coefficients(p := Throttle())
    gain = p.k_TPS * p.sd_w_p
    healthy = dict(zip(monitor.indicators, np.log([p.tau_TPS, gain, k * p.k_TPS / gain, *a]), strict=True))
    limits = {"tau_tps": 5.5, "k_tps": 2.6, "k_et": None, "a1": 3.0, "a2": 3.0, "a3": 3.0}
    for name in monitor.indicators:
        z = np.concatenate([r.frame[f"z.{name}"].to_numpy()[15:] for r in runs["none"]])
        z = z[np.isfinite(z)]
        rows.append(
            Row(
                part=2,
                what=f"z.{name}: standard deviation",
                measured=f"{z.std():.2f}",
                target="0.85 … 1.15",
                holds=0.85 <= z.std() <= 1.15,
            )
        )
    for name, limit in limits.items():
        # a window's own spread, beside what it claims
        x = np.stack([np.log(r.frame[f"indicator.{name}"].to_numpy()[15:]) for r in runs["none"]])
        sd = 100.0 * 1.4826 * float(np.nanmedian(np.abs(x - np.nanmedian(x))))
        rows.append(
            Row(
                part=2,
                what=f"{name}: spread of a window (robust)",
                measured=f"{sd:.1f} %",
                target=f"<= {limit} %" if limit else "",
                holds=None if limit is None else sd <= limit,
            )
        )
    within: list[float] = []
    for fault, group in runs.items():
        truth, worst, most = _truth(fault), (0.0, "", 0.02), 0.0
        for name in monitor.indicators:
            last = np.array([np.nanmean(np.log(r.frame[f"indicator.{name}"].to_numpy()[-5:])) for r in group])
            off = last - healthy[name] - truth.get(name, 0.0)
            own = np.array([_own_sd(r, name) for r in group])
            most = max(most, float(np.abs(off / own).max()))
            within += np.abs(off / own).tolist()
            limit = 0.02 if name in truth else 0.03
            if abs(off.mean()) / limit >= abs(worst[0]) / worst[2]:
                worst = (float(off.mean()), name, limit)
        rows.append(
            Row(
                part=2,
                what=f"{fault}: largest bias over its limit, mean of the last 5 windows",
                measured=f"{worst[0]:+.3f} ({worst[1]})",
                target=f"within {worst[2]}",
                holds=abs(worst[0]) <= worst[2],
            )
        )
        rows.append(
            Row(
                part=2,
                what=f"{fault}: farthest indicator of a single run, in its own sd",
                measured=f"{most:.1f}",
            )
        )
    share = 100.0 * float(np.mean(np.array(within) <= 3.0))
    rows.append(
        Row(
            part=2,
            what=f"indicators of single runs within 3 of their own sd, of {len(within)}",
            measured=f"{share:.1f} %",
            target=">= 99 % (normal: 99.7)",
            holds=share >= 99.0,
        )
    )
    return rows


def _own_sd(run: Run, name: str) -> float:
    """Standard deviation that a run reports for the mean of its last five windows, in ln."""
    value, sigma, z = (run.frame[f"{k}.{name}"].to_numpy()[-5:] for k in ("indicator", "sigma", "z"))
    sd = np.log(value / (value - z * sigma)) / z
    return float(np.sqrt(np.nansum(sd**2)) / np.isfinite(sd).sum())


def _compensation(runs: Mapping[str, Sequence[Run]]) -> list[Row]:
    gain = [r.better for r in runs["tps_gain"]]
    slow = [r.better_systematic for r in runs["tps_time_constant"]]
    total = float(np.median([r.better for r in runs["tps_time_constant"]]))
    healthy = max(1.0 / r.better for r in runs["none"])

    def text(values: Sequence[float], digits: int) -> str:
        return f"{np.median(values):.{digits}f} ({min(values):.{digits}f})"

    what = "e_d / e_r, median (min)"
    return [
        Row(
            part=4, what=f"tps_gain: {what}", measured=text(gain, 0), target=">= 20",
            holds=bool(np.median(gain) >= 20),
        ),
        Row(
            part=4, what=f"tps_time_constant: systematic {what}", measured=text(slow, 1), target=">= 2.5",
            holds=bool(np.median(slow) >= 2.5),
        ),
        Row(
            part=4, what="tps_time_constant: with the noise, median", measured=f"{total:.2f}",
            target="(noise is amplified)",
        ),
        Row(
            part=4, what="fault-free: corrected over raw error, largest", measured=f"{healthy:.4f}",
            target="<= 1.01", holds=healthy <= 1.01,
        ),
    ]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--part", type=int, nargs="+", choices=range(1, 8), default=[1, 3, 5, 6, 7])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=FIRST_SEED)
    parser.add_argument("--slycot", type=Path, help="the source distribution of slycot, for part 6")
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.seeds)
    began, rows = time.perf_counter(), []
    if {1, 2, 4} & set(args.part):
        rows += parts_1_2_4(seeds)
    if 3 in args.part:
        rows += robustness(seeds)
    if 5 in args.part:
        rows += [Row(part=5, **r) for r in (*identification(seeds[:5]), *end_to_end(seeds[0]))]
    if 6 in args.part and args.slycot:
        rows += [Row(part=6, **r) for r in compare(args.slycot)]
    if 7 in args.part:
        rows += printed(seeds[:5])
    width = max((len(r.what) for r in rows), default=0)
    for row in sorted(rows, key=lambda r: r.part):
        mark = {True: "holds", False: "DOES NOT HOLD", None: ""}[row.holds]
        print(f"{row.part}  {row.what:<{width}}  {row.measured:<32}  {row.target:<20}  {mark}".rstrip())
    print(f"{len(seeds)} seeds from {args.first}, {time.perf_counter() - began:.0f} s", file=sys.stderr)
    return 1 if any(r.holds is False for r in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
