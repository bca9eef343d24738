"""Makes the logs of ``data/replay``: short simulated drives and a throttle, thinned to keep them small.

    python -m benchmarks.replay_set [--out data/replay]

Their expected outputs are stored by ``dynoscope replay-check --update``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import polars as pl

from ingest import write_log
from ingest.log import Log
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault

SIGNALS = ("p_Bst", "p_Int", "T_Int", "T_Bst", "W_HFM", "n_Eng", "p_Amb", "T_Amb")
EVERY = 5  # of 50 Hz
DRIVES = (  # name, cycle, seed, seconds, fault, magnitude
    ("training", "udds", 1, 400, None, 0.0),
    ("calibration", "hwfet", 2, 200, None, 0.0),
    ("healthy", "udds", 3, 200, None, 0.0),
    ("maf_low", "udds", 4, 200, "maf_gain", -0.08),
    ("boost_leak", "hwfet", 5, 200, "boost_leak", 8.0),
)
SET = """recipe = "diesel_airpath"
training = ["training.parquet"]
calibration = ["calibration.parquet"]
logs = ["healthy.parquet", "maf_low.parquet", "boost_leak.parquet"]
"""


def small(log: Log) -> Log:
    """The signals that the recipe needs, thinned and in single precision."""
    group = log.groups["ecu"]
    frame = group.frame.gather_every(EVERY).select("time", pl.col(SIGNALS).cast(pl.Float32))
    signals = {n: group.signals[n] for n in SIGNALS}
    return replace(log, groups={"ecu": replace(group, frame=frame, signals=signals)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("data/replay"), metavar="DIR")
    folder = parser.parse_args().out / "diesel_airpath"
    folder.mkdir(parents=True, exist_ok=True)
    for name, cycle, seed, seconds, fault, magnitude in DRIVES:
        faults = [Fault(name=fault, magnitude=magnitude)] if fault else []
        log = simulate_airpath(cycle=cycle, seed=seed, duration_s=seconds, faults=faults, name=name)
        write_log(small(log), folder / f"{name}.parquet")
    (folder / "set.toml").write_text(SET, encoding="utf-8")


if __name__ == "__main__":
    main()
