"""Speed: identification of identical windows by several packages, and a log from file to verdict."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest import read_log, write_log
from ingest.simulators.faults import Fault
from ingest.simulators.throttle import Throttle, plant_coefficients, simulate_throttle
from pipeline import batch
from pipeline.detector import unfitted_detector
from pipeline.diagnosing import diagnose
from pipeline.recipe import load_recipe
from stages.subspace import identify, lag_gram
from stages.two_rate import TwoRate

Array = NDArray[np.float64]
ROWS, ORDER, DECIMATION = 20, 3, 10
WINDOW = 20_000  # samples at full rate
TURNS, SLOW = 20, ("sippy_unipi CVA", "nfoursid")


def slicot(y: Array, u: Array, rows: int, order: int) -> tuple[Array, ...]:
    """A, B, C, D, K by IB01AD (MOESP, Cholesky) and IB01BD (combined)."""
    from ctrlsys import ib01ad, ib01bd

    m, l = u.shape[1], y.shape[1]  # noqa: E741
    _, R, *_ = ib01ad(
        "M", "C", "N", "O", "N", "N", rows, m, l, np.asfortranarray(u), np.asfortranarray(y), 0.0, -1.0
    )
    A, C, B, D, _, _, _, K, *_ = ib01bd("C", "A", "K", rows, order, m, l, len(u), R, 0.0)
    return A, B, C, D, K


def _sippy(y: Array, u: Array) -> Array:
    from sippy_unipi import system_identification

    found = system_identification(y.T, u.T, "CVA", SS_fixed_order=ORDER, SS_f=ROWS, SS_p=ROWS)
    return np.asarray(found.A)


def _nfoursid(y: Array, u: Array) -> Array:
    import pandas as pd
    from nfoursid.nfoursid import NFourSID

    frame = pd.DataFrame({"u": u[:, 0], "y": y[:, 0]})
    found = NFourSID(frame, output_columns=["y"], input_columns=["u"], num_block_rows=ROWS)
    found.subspace_identification()
    model, _ = found.system_identification(rank=ORDER)
    return np.asarray(model.a)


def identification(seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Median ms a window and the error of the fast plant pole, for all packages that are installed."""
    windows = [w for seed in seeds for w in _windows(seed)]
    ways: dict[str, Callable[[Array, Array], Array]] = {
        "ours (CVA, with K)": lambda y, u: identify(lag_gram(y, u, ROWS), 1e-3, order=ORDER).model.A,
        "SLICOT IB01AD + IB01BD": lambda y, u: slicot(y, u, ROWS, ORDER)[0],
        "sippy_unipi CVA": _sippy,
        "nfoursid": _nfoursid,
    }
    for name, way in list(ways.items()):
        try:
            way(*windows[0])  # compiles, imports
        except ImportError:
            del ways[name]
    times, errors = _measure(ways, windows)
    ours, other = times["ours (CVA, with K)"], errors["ours (CVA, with K)"]
    rows: list[dict[str, Any]] = [
        {
            "what": f"{name}: ms a window, error of the 1 ms pole",
            "measured": f"{times[name]:.3f} ms, {errors[name]:.0f} %", "target": "",
        }
        for name in times
    ]  # fmt: skip
    for name, factor in (("SLICOT IB01AD + IB01BD", 1.0), ("sippy_unipi CVA", 50.0), ("nfoursid", 400.0)):
        if name in times:
            ratio = times[name] / ours
            rows.append(
                {
                    "what": f"faster than {name}", "measured": f"{ratio:.2f} x", "target": f">= {factor:g} x",
                    "holds": ratio >= factor,
                }
            )  # fmt: skip
        else:
            rows.append(
                {"what": f"faster than {name}", "measured": "not installed", "target": f">= {factor:g} x"}
            )
    if "SLICOT IB01AD + IB01BD" in errors:
        ratio = errors["SLICOT IB01AD + IB01BD"] / other
        rows.append(
            {
                "what": "error of the 1 ms pole: SLICOT's over ours", "measured": f"{ratio:.1f}",
                "target": ">= 2", "holds": ratio >= 2.0,
            }
        )  # fmt: skip
    return rows


def _windows(seed: int) -> list[tuple[Array, Array]]:
    """Two windows of 2 s behind the low-pass filter, at 1 kHz."""
    log = simulate_throttle(seed=seed, duration_s=4.0)
    y, u = log.values("theta_ang"), log.values("e_a")
    start = TwoRate(decimation=DECIMATION, horizon=ROWS)
    return [start.decimated(u[i : i + WINDOW], y[i : i + WINDOW]) for i in (0, WINDOW)]


def _measure(
    ways: Mapping[str, Callable[[Array, Array], Array]], windows: Sequence[tuple[Array, Array]]
) -> tuple[dict[str, float], dict[str, float]]:
    """Median ms, and median error in % of the fastest pole (100 where it is not stable), of each way.

    The ways take turns, so that what else the machine does hits all of them; slow ones have one turn."""
    _, *a = plant_coefficients(Throttle())
    fastest = np.abs(np.roots([1.0, *a])).max()
    spent: dict[str, list[float]] = {name: [] for name in ways}
    errors: dict[str, list[float]] = {name: [] for name in ways}
    for (y, u), turn in itertools.product(windows, range(TURNS)):
        for name in ways if turn == 0 else [n for n in ways if n not in SLOW]:
            began = time.perf_counter()
            A = ways[name](y, u)
            spent[name].append(time.perf_counter() - began)
            rates = -np.log(np.maximum(np.abs(np.linalg.eigvals(A)), 1e-12)) / 1e-3  # as (3.2)
            errors[name].append(min(100.0 * abs(float(rates.max()) / fastest - 1.0), 1000.0))
    return (
        {name: 1e3 * float(np.median(s)) for name, s in spent.items()},
        {name: float(np.median(e)) for name, e in errors.items()},
    )


def end_to_end(seed: int) -> list[dict[str, Any]]:
    """CPU seconds of a 50 s log at 10 kHz, the least of three turns.

    To the verdict: read, aligned, monitored, compensated. From file to files: also looked through for what is
    suspicious, and everything written that a run leaves (samples, signals, annotated log, verdict, manifest)
    but recording and report. As a command: also Python and its libraries started, and then recording and
    report."""
    detector = unfitted_detector(load_recipe("throttle"))
    fault = Fault(name="tps_gain", magnitude=-0.4, onset_s=25.0, ramp_s=25.0)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "log.parquet", Path(folder) / "out"
        write_log(simulate_throttle(seed=seed, faults=[fault]), path)
        command = f"run {path} --recipe throttle --out {out} --force".split()

        def verdict() -> None:
            diagnose(read_log(path), detector)

        def files() -> None:
            batch.run([path], detector, out, batch.Options(timeline=False, force=True))

        def process(*more: str) -> None:
            words = [sys.executable, "-c", "from pipeline.cli import main; raise SystemExit(main())"]
            subprocess.run([*words, *command, *more], check=True, capture_output=True)

        quick = ("--no-timeline", "--no-report")
        ways: dict[str, tuple[Callable[[], None], float | None]] = {
            "to the verdict": (verdict, None),
            "from file to files": (files, 1.5),
            f"`dynoscope run {' '.join(quick)}`": (lambda: process(*quick), None),
            "`dynoscope run`, with recording and report": (process, None),
        }
        rows = []
        for what, (way, limit) in ways.items():
            way()  # compiles
            spent = min(_cpu(way) for _ in range(3))
            target, holds = (f"<= {limit} s", spent <= limit) if limit else ("", None)
            rows.append(
                {
                    "what": f"50 s at 10 kHz, {what}",
                    "measured": f"{spent:.2f} s",
                    "target": target,
                    "holds": holds,
                }
            )
    return rows


def _cpu(way: Callable[[], None]) -> float:
    """Seconds that this process and those it starts are at work."""
    began = os.times()
    way()
    return sum(os.times()[:4]) - sum(began[:4])
