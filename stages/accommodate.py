"""Accommodate: what the isolated sensor would have read, its estimated fault undone.

Causal: at a time t all that is supposed at the last sample of the diagnosis up to t counts with its
probability p_k then. A sensor is isolated where those that concern it have together at least
``MIN_PROBABILITY``; which of them it is may be open (a gain or an offset; alone or one of two). Each supposes
a correction ``x_k = undo(reading, theta_k)`` with ``s_k = |undo(reading, theta_k + sd_k) - x_k|``. Of those
whose size is known,

    corrected = sum p_k x_k / sum p_k,   corrected_sd^2 = sum p_k (x_k^2 + s_k^2) / sum p_k - corrected^2;

else the reading stands as it is, with 0. What a sensor that does not move or scatters would have read is what
the others expect of it (:mod:`stages.sensors`). (1.1) and (2.3) ask for it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import TIME, Group, Log, Signal
from stages.compensate import CORRECTED, CORRECTED_SD
from stages.formula import Formula
from stages.hypotheses import THETA, Hypothesis
from stages.rarer import Also
from stages.results import DETECTION, EXPECTED, EXPECTED_SD, OF, PAIR, PROBABILITY, SENSOR, SIZE, SIZE_SD

Array = NDArray[np.float64]
MIN_PROBABILITY, NEGLIGIBLE = 0.5, 1e-3


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
    alarm = samples[DETECTION].to_numpy() > 0
    together, (known, shift, square) = np.zeros(samples.height + 1), np.zeros((3, len(reading)))
    for name in (c.removeprefix(PROBABILITY) for c in samples.columns if c.startswith(PROBABILITY)):
        fault = next((f for f in (*name.split(PAIR), name + OF + signal) if f in undoing), None)
        if fault is None and not {SENSOR + name + OF + signal, EXPECTED + signal} <= {*samples.columns}:
            continue
        p = np.where(alarm & _is_of(signal, name, samples), samples[PROBABILITY + name].to_numpy(), 0.0)
        p = np.append(p, 0.0)  # the last for what comes before all samples
        together += p
        if p.max() < NEGLIGIBLE:
            continue
        p = p[row]
        here = np.flatnonzero(p >= NEGLIGIBLE)
        sized = name + OF + fault if fault and PAIR in name else fault or ""
        kinds = (SIZE + sized, SIZE_SD + sized) if fault else (EXPECTED + signal, EXPECTED_SD + signal)
        x, sd = (samples[c].to_numpy()[row[here]] for c in kinds)
        if fault:
            x, sd = _undone(undoing[fault].formulas[signal], signal, reading[here], x, sd)
        found = np.isfinite(x)
        here, moved, sd, p = here[found], (x - reading[here])[found], sd[found], p[here[found]]
        known[here] += p
        shift[here] += p * moved
        square[here] += p * (moved**2 + sd**2)
    isolated = (together[row] >= MIN_PROBABILITY) & (known > 0)
    shift, square = (np.where(isolated, x / np.maximum(known, NEGLIGIBLE), 0.0) for x in (shift, square))
    corrected, sd = reading + shift, np.sqrt(np.maximum(square - shift**2, 0.0))
    written = [signal, signal + CORRECTED, signal + CORRECTED_SD]
    frame = pl.DataFrame({TIME: group.time, **dict(zip(written, (reading, corrected, sd), strict=True))})
    unit = group.signals[signal].unit
    return Group("corrected", frame, {n: Signal(name=n, unit=unit) for n in written})


def _undone(undo: Formula, signal: str, reading: Array, size: Array, sd: Array) -> tuple[Array, Array]:
    """A reading without a fault of a ``size``, and its standard deviation."""
    x = undo({signal: reading, THETA: size})
    return x, np.abs(undo({signal: reading, THETA: size + sd}) - x)


def _is_of(signal: str, fault: str, samples: pl.DataFrame) -> NDArray[np.bool_]:
    """Whether a fault that several sensors can have is most evident of ``signal``; of others, always."""
    columns = [c for c in samples.columns if c.startswith(SENSOR + fault + OF)]
    if not columns:
        return np.ones(samples.height, dtype=bool)
    return np.asarray(
        samples.select(columns).to_numpy().argmax(axis=1) == columns.index(SENSOR + fault + OF + signal)
    )
