"""Part 7: chapter III as printed beside the corrected estimator, and what denoising does to either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from benchmarks.throttle_runs import FAULTS, STAGES, Row, simulate
from ingest.simulators.throttle import Throttle, plant_coefficients
from stages.denoise import Denoise, shrink
from stages.monitor import Monitor
from stages.stage import ANALYSIS, Stage, transform
from stages.subspace import identify, lag_gram

Array = NDArray[np.float64]
FOUR_S = 40_000  # samples


def printed(seeds: Sequence[int]) -> list[Row]:
    align, monitor, *_ = STAGES
    assert isinstance(monitor, Monitor)
    chains: dict[str, list[Stage]] = {
        "corrected": [align, monitor],
        "as printed": [align, replace(monitor, estimator="printed")],
        "corrected, after denoising": [align, Denoise(columns=("theta_ang",), samples=10_000), monitor],
    }
    rows = []
    for what, chain in chains.items():
        frames = {f: [_logs(chain, f, s) for s in seeds] for f in ("none", "tps_time_constant", "tps_gain")}
        spread = [_spread(frame["tau_tps"]) for frame in frames["none"]]
        level = np.exp(np.nanmedian([frame["tau_tps"].median() for frame in frames["none"]])) * 1e4
        text = f"{100 * np.median(spread):.0f} % about {level:.1f}e-4 s"
        rows.append(Row(part=7, what=f"{what}: spread of tau_tps, fault-free", measured=text))
        for fault, truth in (("tps_time_constant", 0.0), ("tps_gain", -0.446)):
            moved = [f["k_tps"][-5:].mean() - f["k_tps"][:20].mean() for f in frames[fault]]
            change = f"{np.mean(np.array(moved, dtype=float)):+.3f}"
            rows.append(
                Row(part=7, what=f"{what}: ln k_tps under {fault}", measured=change, target=f"{truth:+.3f}")
            )
    return rows + _slow_poles(seeds)


def _logs(chain: Sequence[Stage], fault: str, seed: int) -> pl.DataFrame:
    """Logarithms of the indicators by window; what is not known is left out of means."""
    frame = transform(chain, simulate(FAULTS[fault], seed)).groups[ANALYSIS].frame
    return frame.select(pl.col(f"indicator.{n}").log().alias(n) for n in ("tau_tps", "k_tps"))


def _spread(x: pl.Series) -> float:
    known = x.drop_nulls().to_numpy()
    return float(1.4826 * np.median(np.abs(known - np.median(known))))


def _slow_poles(seeds: Sequence[int]) -> list[Row]:
    """CVA of order 4 at the full rate over 4 s, from the signals as they are and denoised."""
    _, *a = plant_coefficients(Throttle())
    truth = np.sort(np.abs(np.roots([1.0, *a])))[:2]
    errors: dict[str, list[Array]] = {"as they are": [], "denoised": []}
    for seed in seeds:
        log = simulate((), seed)
        y, u = (log.values(n)[:FOUR_S] for n in ("theta_ang", "e_a"))
        for what, reading in (("as they are", y), ("denoised", shrink(y))):
            poles = identify(lag_gram(reading[:, None], u[:, None], 20), 1e-4, order=4).model.poles
            errors[what].append(np.abs(np.abs(poles.real[:2]) / truth - 1.0))
    return [
        Row(
            part=7,
            what=f"full-rate CVA, signals {what}: error of the 1.3 s and 29 ms poles",
            measured=", ".join(f"{100 * e:.0f} %" for e in np.median(found, axis=0)),
        )
        for what, found in errors.items()
    ]
