"""Accommodate: what the isolated sensor would have read, its estimated fault undone.

Causal: at a time t the fault is the one that is named at the last sample of the diagnosis up to t, with its
size theta and standard deviation s then. From there on ``corrected = undo(reading, theta)``, and
``corrected_sd = |undo(reading, theta + s) - corrected|``; before, and where another fault is named or none
with a probability of ``MIN_PROBABILITY``, the reading stands as it is, with 0. (1.1) and (2.3) ask for it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import TIME, Group, Log, Signal
from stages.compensate import CORRECTED, CORRECTED_SD
from stages.hypotheses import THETA, Hypothesis
from stages.results import DETECTION, OF, PAIR, PROBABILITY, SIZE, SIZE_SD

Array = NDArray[np.float64]
MIN_PROBABILITY = 0.5


def accommodate(
    log: Log, samples: pl.DataFrame, signal: str, hypotheses: Mapping[str, Hypothesis]
) -> Group | None:
    """``signal`` at its own rate as it was read, ``<signal>.corrected`` and ``<signal>.corrected_sd``; None
    where no hypothesis says how to correct its readings."""
    concerned = {
        fault: h
        for fault, h in hypotheses.items()
        if h.signal == signal and signal in h.formulas and h.needs <= {signal}
    }
    if not concerned or signal not in log.signals:
        return None
    group = log.group_of(signal)
    reading = log.values(signal)
    row = np.searchsorted(samples[TIME].to_numpy(), group.time, side="right") - 1
    names = [c.removeprefix(PROBABILITY) for c in samples.columns if c.startswith(PROBABILITY)]
    p = samples.select(PROBABILITY + f for f in names).to_numpy()
    sure = (samples[DETECTION].to_numpy() > 0) & (p.max(axis=1) >= MIN_PROBABILITY)
    named = np.append(np.where(sure, p.argmax(axis=1), -1), -1)  # the last for what comes before all samples
    corrected, sd = reading.copy(), np.zeros_like(reading)
    for k, name in enumerate(names):
        fault = next((f for f in name.split(PAIR) if f in concerned), None)
        here = named[row] == k
        if fault is None or not here.any():
            continue
        sized = name if name == fault else name + OF + fault
        size, width = (samples[kind + sized].to_numpy()[row[here]] for kind in (SIZE, SIZE_SD))
        undo = concerned[fault].formulas[signal]
        corrected[here] = undo({signal: reading[here], THETA: size})
        sd[here] = np.abs(undo({signal: reading[here], THETA: size + width}) - corrected[here])
    written = [signal, signal + CORRECTED, signal + CORRECTED_SD]
    frame = pl.DataFrame({TIME: group.time, **dict(zip(written, (reading, corrected, sd), strict=True))})
    unit = group.signals[signal].unit
    return Group("corrected", frame, {n: Signal(name=n, unit=unit) for n in written})
