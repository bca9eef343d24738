"""Logs and a detector for the benchmarks of batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl

from ingest import write_log
from ingest.log import Group, Log
from ingest.recording import recording
from ingest.simulators.airpath import Fault, simulate_airpath
from pipeline import fit, load_recipe
from pipeline.detector import Detector
from pipeline.store import Store

RECIPE = "diesel_airpath"
SIGNALS = (
    "p_Int", "p_Bst", "T_Int", "T_Bst", "W_HFM", "n_Eng", "p_Amb", "T_Amb", "W_Fuel", "p_Exh", "u_Vnt",
    "v_Veh", "lambda", "u_Egr",
)  # fmt: skip
FAULTS: Sequence[tuple[str, float] | None] = (
    None, ("maf_gain", -0.07), None, ("boost_leak", 7.0), None, ("intake_pressure_gain", 0.05),
    ("boost_pressure_gain", -0.05), None, ("intake_leak", 6.0), None,
)  # fmt: skip


def detector(folder: Path) -> Detector:
    """Fitted on one drive, calibrated on another, kept in ``folder/store``."""
    training, calibration = (simulate_airpath(cycle="wltc_3b", seed=seed, name=f"s{seed}") for seed in (1, 2))
    found = fit([training], load_recipe(RECIPE), [calibration])
    Store(folder / "store").add(found)
    return found


def drive(seed: int, seconds: float) -> Log:
    """A drive with the seed's fault, or none."""
    fault = FAULTS[seed % len(FAULTS)]
    faults = [Fault(name=fault[0], magnitude=fault[1])] if fault else []
    return simulate_airpath(
        cycle="wltc_3b", seed=1000 + seed, faults=faults, duration_s=seconds, name=f"{seed}"
    )


def thin(log: Log) -> Log:
    """Only the 50 Hz group, with 14 signals, as a test bench might record it."""
    group = log.groups["ecu"]
    names = [n for n in SIGNALS if n in group.signals]
    ecu = Group("ecu", group.frame.select("time", *names), {n: group.signals[n] for n in names})
    return replace(log, groups={"ecu": ecu})


def write_drives(folder: Path, count: int, seconds: float, *, different: int) -> list[Path]:
    """``count`` Parquet logs, of which ``different`` are different."""
    folder.mkdir(parents=True)
    paths = [folder / f"drive{i:04d}.parquet" for i in range(count)]
    for i, path in enumerate(paths[:different]):
        write_log(thin(drive(i, seconds)), path)
    for i, path in enumerate(paths[different:], start=different):
        path.hardlink_to(paths[i % different])
    return paths


def repeated(log: Log, times: int, path: Path) -> Path:
    """A log end to end with itself."""
    start, end = log.span
    with recording(path, log) as recorder:
        for i in range(times):
            shift = i * (end - start + 0.02)
            groups = {
                k: replace(g, frame=g.frame.with_columns(pl.col("time") + shift))
                for k, g in log.groups.items()
            }
            recorder.add(replace(log, groups=groups))
        recorder.finish(log, {})
    return path


def damage(path: Path, way: int) -> None:
    """Damages a log in one of ten ways that really happen."""
    content = path.read_bytes()
    half = len(content) // 2
    rng = np.random.default_rng(way)
    noise = bytes(rng.integers(0, 256, 4096, np.uint8))
    ways = (
        content[:half], b"", content[: len(content) - 7], content[:100], noise,
        content[:half] + noise + content[half + len(noise) :],  # a block overwritten
        content[:half] + bytes([content[half] ^ 1]) + content[half + 1 :],  # one bit
        bytes(len(content)),  # a file system's zeros
        content[:-4096] + bytes(4096), content[half:],
    )  # fmt: skip
    path.write_bytes(ways[way])
