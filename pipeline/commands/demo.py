"""``dynoscope demo``: the main job from nothing, on simulated drives."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

HELP = (
    "the main job from nothing: simulate drives, ingest, fit, diagnose, write timelines, print the verdicts"
)
RECIPE = "diesel_airpath"
TRAINING = (("wltc_3b", 1),)
CALIBRATION = (("ftp75", 2), ("hwfet", 3), ("us06", 4))
DRIVES = (  # name, cycle, seed, fault, magnitude
    ("healthy", "udds", 11, None, 0.0),
    ("maf_low", "udds", 12, "maf_gain", -0.05),
    ("boost_sensor", "udds", 13, "boost_pressure_gain", 0.02),
    ("intake_sensor", "udds", 14, "intake_pressure_gain", -0.02),
    ("boost_leak", "udds", 15, "boost_leak", 6.0),
    ("intake_leak", "hwfet", 16, "intake_leak", 6.0),
)
DURATION_S = 760.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help="default: ./demo")


def run(args: argparse.Namespace) -> int:
    from ingest import read_log, write_log
    from ingest.simulators.airpath import simulate_airpath
    from ingest.simulators.faults import Fault
    from pipeline import batch
    from pipeline.commands.run import describe, print_summary
    from pipeline.console import progress, talk
    from pipeline.fitting import fit
    from pipeline.recipe import load_recipe
    from pipeline.reporting import write_report
    from pipeline.store import Store

    began = time.perf_counter()
    logs, store = args.out / "logs", Store(args.out / "store")
    healthy = [(f"fault_free_{cycle}", cycle, seed) for cycle, seed in (*TRAINING, *CALIBRATION)]
    with progress("simulating", len(healthy) + len(DRIVES)) as step:
        for name, cycle, seed in healthy:
            write_log(simulate_airpath(cycle=cycle, seed=seed, name=name), logs / f"{name}.mcap")
            step(f"{name}: fault-free {cycle}")
        for name, cycle, seed, fault, magnitude in DRIVES:
            faults = [Fault(name=fault, magnitude=magnitude)] if fault else []
            log = simulate_airpath(cycle=cycle, seed=seed, faults=faults, duration_s=DURATION_S, name=name)
            write_log(log, logs / f"{name}.mcap")
            step(f"{name}: {cycle}, {f'{fault} {magnitude:g}' if fault else 'fault-free'}")
    training, *calibration = (read_log(logs / f"{name}.mcap") for name, _, _ in healthy)
    detector = fit([training], load_recipe(RECIPE), calibration, progress=talk)
    store.add(detector)
    drives = [logs / f"{name}.mcap" for name, *_ in DRIVES]
    with progress("diagnosing", len(drives)) as step:
        summary = batch.run(
            drives, detector, args.out / "out", progress=lambda log, row: step(describe(log, row))
        )
    page = write_report(args.out / "out")
    print_summary(summary.to_dicts())
    talk(
        f"{time.perf_counter() - began:.0f} s. Look at a drive: "
        f"dynoscope view {args.out / 'out' / 'boost_leak'}, at all of them: {page}"
    )
    return 0
