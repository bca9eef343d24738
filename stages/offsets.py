"""Offsets and correlation: how far a healthy system's residuals are off zero for minutes, and for how long
their errors stay the same, learned from several logs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ingest.log import TIME, Log
from stages.gate import GATE
from stages.residuals import RESIDUAL, SIGMA
from stages.stage import Arrays, columns

Array = NDArray[np.float64]
MIN_LOGS = 3  # fewer do not tell what differs from run to run
LEAST = 1e-12
LEAST_WANDER = 0.3  # of what differs from log to log
SPAN_S = 30.0  # errors of longer are offsets
LONGEST_S = 10.0


def learned_offsets(
    blocks: Sequence[Log],
    residuals: Sequence[str],
    given: Array,
    given_shape: Array,
    shapes: Sequence[Array],
    span_s: float,
    correlation_s: float,
) -> Arrays:
    """All that this module learns, each (residuals,), from what is supposed: ``offset_sd``, ``shape_sd``,
    ``wander_sd``, ``correlation_s``."""
    sd = offset_sd(blocks, residuals, given, span_s, correlation_s)
    lasting = correlation_times(blocks, residuals, correlation_s)
    return {
        "offset_sd": sd,
        "shape_sd": shape_sd(blocks, residuals, shapes, given_shape, correlation_s),
        "wander_sd": wander_sd(blocks, residuals, sd, span_s, lasting),
        "correlation_s": lasting,
    }


def offset_sd(
    blocks: Sequence[Log], residuals: Sequence[str], given: Array, span_s: float, correlation_s: float
) -> Array:
    """Standard deviation of each residual's mean over ``span_s``, shape (residuals,).

    ``sqrt((given^2 + sum_logs mean_spans (m^2 - v)) / (logs + 1))``, where m are weighted means and v is the
    variance that noise of correlation time ``correlation_s`` gives them: what is supposed counts as one log.
    With fewer than ``MIN_LOGS`` different logs it is ``given``.
    """
    if len({block.name for block in blocks}) < MIN_LOGS:
        return given
    square = given**2
    for block in blocks:
        values = columns(block)
        time = values[TIME]
        part = ((time - time[0]) // span_s).astype(int)
        samples = max(1.0, correlation_s / float(np.median(np.diff(time))))
        for i, r in enumerate(residuals):
            S, mean = _by_span(values[RESIDUAL + r], values[SIGMA + r], part)
            square[i] += max(float(np.average(mean**2 - samples / S, weights=S)), 0.0)
    return np.asarray(np.sqrt(square / (len(blocks) + 1)))


def shape_sd(
    blocks: Sequence[Log],
    residuals: Sequence[str],
    shapes: Sequence[Array],
    given: Array,
    correlation_s: float,
) -> Array:
    """Standard deviation from log to log of how much of a shape h each residual holds, shape (residuals,).

    With weights ``w = 1 / sigma^2``, a log's is ``c = sum w h e / sum w h^2``. ``shapes``: h by log, each
    (rows, residuals). As in :func:`offset_sd`, what is ``given`` counts as one log, and alone with fewer than
    ``MIN_LOGS`` different ones. A shape that no log shows has none.
    """
    few = len({block.name for block in blocks}) < MIN_LOGS
    square, shown = given**2, np.zeros(len(residuals), dtype=bool)
    for block, h in zip(blocks, shapes, strict=True):
        values = columns(block)
        samples = max(1.0, correlation_s / float(np.median(np.diff(values[TIME]))))
        for i, r in enumerate(residuals):
            e, sigma = values[RESIDUAL + r], values[SIGMA + r]
            known = np.isfinite(e) & np.isfinite(h[:, i])
            w, x = np.where(known, 1 / sigma**2, 0.0), np.where(known, h[:, i], 0.0)
            mass = float((w * x**2).sum())
            shown[i] |= mass > LEAST
            if mass > LEAST and not few:
                c = float((w * x * np.nan_to_num(e)).sum()) / mass
                square[i] += max(c**2 - samples / mass, 0.0)
    return np.asarray(np.where(shown, np.sqrt(square / (1 if few else len(blocks) + 1)), 0.0))


def wander_sd(
    blocks: Sequence[Log], residuals: Sequence[str], offset_sd: Array, span_s: float, correlation_s: Array
) -> Array:
    """Standard deviation of each residual's mean over ``span_s`` about the log's own, shape (residuals,).

    With m and v as in :func:`offset_sd`, S the spans' sums of weights and M the log's mean,

        sqrt((LEAST_WANDER offset_sd)^2 + sum S [(m - M)^2 - v (1 - S / sum S)] / sum S).

    With fewer than ``MIN_LOGS`` different logs it is not known, and infinite.
    """
    if len({block.name for block in blocks}) < MIN_LOGS:
        return np.full(len(residuals), np.inf)
    sums = np.zeros((2, len(residuals)))
    for block in blocks:
        values = columns(block)
        time = values[TIME]
        part = ((time - time[0]) // span_s).astype(int)
        dt = float(np.median(np.diff(time)))
        for i, r in enumerate(residuals):
            S, mean = _by_span(values[RESIDUAL + r], values[SIGMA + r], part)
            away = mean - np.average(mean, weights=S)
            samples = max(1.0, correlation_s[i] / dt)
            sums[:, i] += (S * away**2 - samples * (1 - S / S.sum())).sum(), S.sum()
    return np.asarray(np.sqrt((LEAST_WANDER * offset_sd) ** 2 + np.maximum(sums[0] / sums[1], 0.0)))


def _by_span(e: Array, sigma: Array, part: NDArray[np.int64]) -> tuple[Array, Array]:
    """Sums of weights, and weighted means, of the rows of each span ``part``, both (spans,)."""
    weight = np.where(np.isfinite(e), 1 / sigma**2, 0.0)
    S = np.maximum(np.bincount(part, weight), LEAST)
    return S, np.bincount(part, weight * np.nan_to_num(e)) / S


def correlation_times(blocks: Sequence[Log], residuals: Sequence[str], given_s: float) -> Array:
    """How long a residual's errors stay the same, in s, shape (residuals,).

    Were they independent from sample to sample, the squares of their sums over spans would be the sums of
    their squares. With w the gate, z_i the residual over its spread less the log's mean, dt between samples,

        tau = dt sum_spans (sum_i w_i z_i)^2 / sum_i (w_i z_i)^2,

    at least ``given_s``, as what is not in these logs may last longer, and at most ``LONGEST_S``; spikes
    count as 5 spreads. With fewer than ``MIN_LOGS`` different logs it is ``given_s``.
    """
    if len({block.name for block in blocks}) < MIN_LOGS:
        return np.full(len(residuals), given_s)
    sums = np.zeros((2, len(residuals)))
    for block in blocks:
        values = columns(block)
        time = values[TIME]
        part = ((time - time[0]) // SPAN_S).astype(int)
        for i, r in enumerate(residuals):
            z = np.clip(values[RESIDUAL + r] / values[SIGMA + r], -5.0, 5.0)
            w = np.where(np.isfinite(z), np.nan_to_num(values.get(GATE, np.ones(time.size))), 0.0)
            z = w * (np.nan_to_num(z) - np.average(np.nan_to_num(z), weights=np.maximum(w, LEAST)))
            dt = float(np.median(np.diff(time)))
            sums[:, i] += dt * (np.bincount(part, z) ** 2).sum(), (z**2).sum()
    return np.asarray(np.clip(sums[0] / np.maximum(sums[1], LEAST), given_s, LONGEST_S))
