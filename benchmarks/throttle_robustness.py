"""Part 3: small, opposite, unlisted and simultaneous faults; other surroundings."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from benchmarks.throttle_runs import FAULTS, Changes, Row, monitored, simulate

GAINS = ("tps_gain", "motor_torque_constant", "back_emf_constant")
SMALL: list[Changes] = [[("tps_time_constant", 0.2)], *([(name, -0.1)] for name in GAINS)]
OPPOSITE: list[Changes] = [[("tps_time_constant", -0.3)], *([(name, 0.4)] for name in GAINS)]
UNLISTED: list[Changes] = [[(name, m)] for name in ("R_a", "L_a", "K_sp") for m in (-0.3, 0.4)]
PAIRS: list[Changes] = [
    [*one, *two] for one, two in itertools.combinations([c for c in FAULTS.values() if c], 2)
]
SURROUNDINGS: dict[str, dict[str, float]] = {
    "closed loop": {"closed_loop": 1.0},
    "4 x noise": {"sd_w_n": 4e-3},
    "sparse pedal": {"pedal_hold": 1.0},
    "coloured disturbance, 0.5 ms": {"tau_w_p": 5e-4},
    "tau_TPS 1e-4 s": {"tau_TPS": 1e-4},
    "tau_TPS 5e-4 s": {"tau_TPS": 5e-4},
    "abrupt": {"ramp": 0.0},
}


def robustness(seeds: Sequence[int]) -> list[Row]:
    rows, single = [], []
    for what, cases, least in (("small faults (20 %, 10 %)", SMALL, 95), ("opposite signs", OPPOSITE, 95)):
        single += (named := _named(cases, seeds))
        rows.append(_row(what, named, "right", least))
    for what, cases in (("R_a, L_a, K_sp", UNLISTED), ("two at once", PAIRS)):
        named = [(said, "unknown") for said, _ in _named(cases, seeds)]
        rows.append(_row(what, named, "unknown", 90))
    noise = [(said, "none") for said, _ in _named([[("sd_w_n", 1.0)]], seeds)]
    rows.append(_row("measurement noise doubles", noise, "none", 100))
    for what, settings in SURROUNDINGS.items():
        single += (named := _named(list(FAULTS.values()), seeds, **settings))
        rows.append(_row(what, named, "right", 90))
    share = 100.0 * sum(said == "unknown" for said, _ in single) / len(single)
    rows.append(
        Row(
            part=3, what=f"single faults called unknown, of {len(single)} above", measured=f"{share:.1f} %",
            target="<= 2 %", holds=share <= 2.0,
        )
    )  # fmt: skip
    return rows


def _named(cases: Sequence[Changes], seeds: Sequence[int], **settings: float) -> list[tuple[str, str]]:
    """What was said, and the first change that was made."""
    return [
        (monitored(simulate(case, seed, **settings)).named, case[0][0] if case else "none")
        for case in cases
        for seed in seeds
    ]


def _row(what: str, named: Sequence[tuple[str, str]], word: str, least: float) -> Row:
    good = sum(said == right for said, right in named)
    measured, holds = f"{good}/{len(named)} {word}", 100 * good >= least * len(named)
    return Row(part=3, what=what, measured=measured, target=f">= {least:g} %", holds=holds)
