"""How probable each hypothesis was over time, and the evidence behind it."""

from __future__ import annotations

import numpy as np
import polars as pl
import rerun as rr

from stages.results import PAIR, Diagnosis
from viz import send
from viz.colours import of_fault
from viz.series import Array, break_at_gaps, numbers

LEADING = 8
"""Hypotheses in the plots; the others are in the recording beside them."""


def log_evidence(rec: rr.RecordingStream, diagnosis: Diagnosis) -> None:
    """``p.*`` below ``/probability``, ``evidence.*`` below ``/evidence``; each ``leading`` and ``others``."""
    samples = diagnosis.samples
    first = leading(samples)
    for root, prefix, stepped in (("probability", "p.", True), ("evidence", "evidence.", False)):
        present = [c.removeprefix(prefix) for c in samples.columns if c.startswith(prefix)]
        ranked = [fault for fault in first if fault in present]
        for part, faults in (("leading", ranked[:LEADING]), ("others", ranked[LEADING:])):
            if faults := faults[::-1]:  # the last line lies on top of those it hides
                time, values = table(samples, [prefix + fault for fault in faults])
                path = send.entity(root, part)
                colours = [of_fault(fault) for fault in faults]
                send.lines(rec, path, time, values, names=faults, colours=colours, stepped=stepped)


def table(samples: pl.DataFrame, columns: list[str]) -> tuple[Array, Array]:
    """Time (m,) and columns (m, k) of the samples as float64, broken at gaps."""
    values = samples.select(pl.col(c).cast(pl.Float64).fill_null(float("nan")) for c in columns)
    return break_at_gaps(samples["time"].to_numpy(), send.flat(values.to_numpy()))


def leading(samples: pl.DataFrame) -> list[str]:
    """All hypotheses, those that were ever most probable first, then by their greatest evidence; of two
    faults at once only those that were ever likely."""
    faults = dict.fromkeys(c.split(".", 1)[1] for c in samples.columns if c.startswith(("p.", "evidence.")))

    def weight(fault: str) -> tuple[float, float]:
        return _greatest(samples, f"p.{fault}"), _greatest(samples, f"evidence.{fault}")

    likely = [f for f in faults if PAIR not in f or weight(f)[0] > 0.02]
    return sorted(likely, key=weight, reverse=True)


def _greatest(samples: pl.DataFrame, column: str) -> float:
    if column not in samples.columns or not samples.height:
        return -np.inf
    values = numbers(samples[column])
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else -np.inf
