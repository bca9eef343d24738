"""Accommodate: what the isolated sensor would have read, its estimated fault undone.

Causal: at a time t the fault is the one that is named at the last sample of the diagnosis up to t, with its
size theta and standard deviation s then. From there on ``corrected = undo(reading, theta)``, and
``corrected_sd = |undo(reading, theta + s) - corrected|``; before, and where another fault is named or none
with a probability of ``MIN_PROBABILITY``, the reading stands as it is, with 0. What a sensor that does not
move or scatters would have read is what the others expect of it (:mod:`stages.sensors`). (1.1) and (2.3) ask
for it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import TIME, Group, Log, Signal
from stages.compensate import CORRECTED, CORRECTED_SD
from stages.hypotheses import THETA, Hypothesis
from stages.rarer import Also
from stages.results import DETECTION, EXPECTED, EXPECTED_SD, OF, PAIR, PROBABILITY, SENSOR, SIZE, SIZE_SD

Array = NDArray[np.float64]
MIN_PROBABILITY = 0.5


def accommodate(
    log: Log,
    samples: pl.DataFrame,
    signal: str,
    hypotheses: Mapping[str, Hypothesis],
    rarer: Also | None = None,
) -> Group | None:
    """``signal`` at its own rate as it was read, ``<signal>.corrected`` and ``<signal>.corrected_sd``; None
    where nothing says how to correct its readings."""
    undoing = {
        fault: h
        for fault, h in hypotheses.items()
        if h.signal == signal and signal in h.formulas and h.needs <= {signal}
    }
    undoing |= {fault + OF + signal: h[signal] for fault, h in (rarer or {}).items() if signal in h}
    if signal not in log.signals or not (undoing or EXPECTED + signal in samples.columns):
        return None
    group = log.group_of(signal)
    reading = log.values(signal)
    row = np.searchsorted(samples[TIME].to_numpy(), group.time, side="right") - 1
    names = [c.removeprefix(PROBABILITY) for c in samples.columns if c.startswith(PROBABILITY)]
    p = samples.select(PROBABILITY + f for f in names).to_numpy()
    sure = (samples[DETECTION].to_numpy() > 0) & (p.max(axis=1) >= MIN_PROBABILITY)
    corrected, sd = reading.copy(), np.zeros_like(reading)
    for k, name in enumerate(names):
        fault = next((f for f in (*name.split(PAIR), name + OF + signal) if f in undoing), None)
        if fault is None and not {SENSOR + name + OF + signal, EXPECTED + signal} <= {*samples.columns}:
            continue
        named = sure & (p.argmax(axis=1) == k) & _is_of(signal, name, samples)
        here = np.append(named, False)[row]  # the last for what comes before all samples
        if fault is None:
            there, width = (samples[kind + signal].to_numpy()[row[here]] for kind in (EXPECTED, EXPECTED_SD))
            corrected[here] = np.where(np.isfinite(there), there, reading[here])
            sd[here] = np.where(np.isfinite(there), width, 0.0)
            continue
        sized = name + OF + fault if PAIR in name else fault
        size, width = (samples[kind + sized].to_numpy()[row[here]] for kind in (SIZE, SIZE_SD))
        undo = undoing[fault].formulas[signal]
        corrected[here] = undo({signal: reading[here], THETA: size})
        sd[here] = np.abs(undo({signal: reading[here], THETA: size + width}) - corrected[here])
    written = [signal, signal + CORRECTED, signal + CORRECTED_SD]
    frame = pl.DataFrame({TIME: group.time, **dict(zip(written, (reading, corrected, sd), strict=True))})
    unit = group.signals[signal].unit
    return Group("corrected", frame, {n: Signal(name=n, unit=unit) for n in written})


def _is_of(signal: str, fault: str, samples: pl.DataFrame) -> NDArray[np.bool_]:
    """Whether a fault that several sensors can have is most evident of ``signal``; of others, always."""
    columns = [c for c in samples.columns if c.startswith(SENSOR + fault + OF)]
    if not columns:
        return np.ones(samples.height, dtype=bool)
    return np.asarray(
        samples.select(columns).to_numpy().argmax(axis=1) == columns.index(SENSOR + fault + OF + signal)
    )
