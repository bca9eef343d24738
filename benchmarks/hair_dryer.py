"""Subspace identification of a real process: the hair dryer of Ljung's book, against SLICOT's results.

The data (a Feedback PT326 process trainer, 1000 samples of 0.08 s) and the printed results of IB01BD for
order 4 and 15 block rows lie in the source distribution of the Python package slycot, as SLICOT's own
example.
"""

from __future__ import annotations

import re
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.statespace import StateSpace
from stages.subspace import identify, lag_gram

Array = NDArray[np.float64]
DT = 0.08
ROWS, ORDER = 15, 4
EXAMPLES = "SLICOT-Reference/examples/"


def read(slycot: Path) -> tuple[Array, Array, dict[str, Array]]:
    """Input (1000, 1), output (1000, 1), and the printed matrices."""
    with tarfile.open(slycot) as archive:
        texts = {}
        for member in archive.getmembers():
            name = member.name.rpartition(EXAMPLES)[2]
            if name in ("IB01BD.dat", "IB01BD.res") and (file := archive.extractfile(member)):
                texts[name] = file.read().decode()
    numbers = re.findall(r"^\s*(-?[\d.]+)\s*$", texts["IB01BD.dat"], re.M)
    values = np.array([float(x) for x in numbers])
    samples = values.size // 2
    matrices = {}
    for letter, what in (
        ("A", "state"),
        ("B", "input"),
        ("C", "output"),
        ("D", "input-output"),
        ("K", "gain"),
    ):
        after = re.split(rf"The [^\n]*matrix {letter} is *\n", texts["IB01BD.res"])[1]
        lines = re.match(r"((?:[ \t]*-?\d[^\n]*\n)+)", after)
        assert lines, f"no matrix {letter} ({what}) in the printed results"
        matrices[letter] = np.array([[float(x) for x in line.split()] for line in lines[1].splitlines()])
    return values[:samples, None], values[samples:, None], matrices


def fit_percent(y: Array, predicted: Array) -> float:
    return float(100.0 * (1.0 - np.linalg.norm(y - predicted) / np.linalg.norm(y - y.mean())))


def compare(slycot: Path) -> list[dict[str, Any]]:
    """Our poles and fits beside those of the printed model, and fits on the half that was not used."""
    u, y, printed = read(slycot)
    theirs = StateSpace(**{k: printed[k] for k in "ABCDK"}, R=np.eye(1), dt=DT)
    ours = identify(lag_gram(y, u, ROWS), DT, order=ORDER, method="moesp").model
    eigenvalues = [np.sort_complex(np.linalg.eigvals(m.A)) for m in (ours, theirs)]
    apart = float(np.abs(eigenvalues[0] - eigenvalues[1]).max())
    rows: list[dict[str, Any]] = [
        {
            "what": "hair dryer: poles against SLICOT's printed ones (MOESP, n = 4, s = 15)",
            "measured": f"apart by {apart:.1e}", "target": "<= 1e-3 (4 digits)", "holds": apart <= 1e-3,
        }
    ]  # fmt: skip
    predicted = [fit_percent(y[20:], m.predict(y, u)[20:]) for m in (ours, theirs)]
    rows.append(
        {
            "what": "hair dryer: one-step fit, ours and the printed model",
            "measured": f"{predicted[0]:.2f} %, {predicted[1]:.2f} %", "target": "not less",
            "holds": predicted[0] >= predicted[1] - 0.05,
        }
    )  # fmt: skip
    return rows + _held_out(u, y)


def _held_out(u: Array, y: Array) -> list[dict[str, Any]]:
    """Identified on the first half, simulated on the second: CVA, our MOESP, SLICOT's own."""
    half, mean = len(u) // 2, (u[: len(u) // 2].mean(), y[: len(u) // 2].mean())
    u, y = u - mean[0], y - mean[1]
    fits = {}
    for method in ("cva", "moesp", "n4sid"):
        found = identify(lag_gram(y[:half], u[:half], ROWS), DT, order=ORDER, method=method)
        model = found.model
        fits[method] = fit_percent(
            y[half:], model.simulate(u[half:], model.initial_state(y[half:], u[half:]))
        )
    chosen = identify(lag_gram(y[:half], u[:half], ROWS), DT).order
    text = ", ".join(f"{k} {v:.1f} %" for k, v in fits.items())
    row = {
        "what": f"hair dryer: simulated on the held-out half (criterion's own order: {chosen})",
        "measured": text,
        "target": "SLICOT's",
    }
    try:
        from benchmarks.throttle_speed import slicot
    except ImportError:
        return [row | {"holds": None}]
    A, B, C, D, K = slicot(y[:half], u[:half], ROWS, ORDER)
    model = StateSpace(A=A, B=B, C=C, D=D, K=K, R=np.eye(1), dt=DT)
    theirs = fit_percent(y[half:], model.simulate(u[half:], model.initial_state(y[half:], u[half:])))
    return [row | {"target": f"SLICOT {theirs:.1f} %", "holds": max(fits.values()) >= theirs - 0.1}]
