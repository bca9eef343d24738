"""A monitored sensor: its raw reading beside the corrected one, their errors, and the poles of sensor and
plant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr

from ingest.log import Log
from stages.results import Diagnosis
from viz import send
from viz.colours import DIM, GREY, ORANGE, SKY_BLUE, WHITE, ramp
from viz.residuals import column
from viz.series import TRUTH, Array, break_at_gaps, envelope, limits
from viz.signals import ENVELOPE_POINTS

CORRECTED = ".corrected"
READINGS, ERRORS, POLES = "/sensor/readings", "/sensor/errors", "/poles"
DECADE = 20.0
"""Picture units to one decade of a pole's distance from the origin."""


@dataclass(frozen=True, kw_only=True)
class Monitored:
    """What was drawn: titles and limits of the two plots, None where no sensor is corrected, and the poles'
    box ``(x, y)`` limits, None where there are none."""

    readings: tuple[str, tuple[float, float]] | None
    errors: tuple[str, tuple[float, float]] | None
    poles: tuple[tuple[float, float], tuple[float, float]] | None


def log_monitoring(rec: rr.RecordingStream, diagnosis: Diagnosis) -> Monitored | None:
    """Readings, errors and poles of a run that has any, else None."""
    readings = errors = None
    group = diagnosis.signals
    name = next((n for n in group.signals if n.endswith(CORRECTED)), None) if group else None
    if group is not None and name is not None:
        signal = name.removesuffix(CORRECTED)
        unit = group.signals[name].unit or "?"
        raw, corrected = column(group.frame, signal), column(group.frame, name)
        both = np.stack([raw, corrected], axis=1)
        readings = (
            f"{signal} as read and corrected [{unit}]",
            _plot(rec, READINGS, group.time, both, signal),
        )
        truth = _truth(diagnosis.log, signal, group.time)
        text = f"Error of {signal} [{unit}]" if truth is not None else f"Correction of {signal} [{unit}]"
        errors = (
            text,
            _plot(rec, ERRORS, group.time, both - (raw if truth is None else truth)[:, None], signal),
        )
    poles = _log_poles(rec, diagnosis)
    return Monitored(readings=readings, errors=errors, poles=poles) if readings or poles else None


def _truth(log: Log, signal: str, time: Array) -> Array | None:
    """What a healthy sensor would have read, where a simulator tells, at the same times."""
    if TRUTH + signal not in log.signals:
        return None
    values = log.values(TRUTH + signal)
    return values if np.array_equal(log.group_of(TRUTH + signal).time, time) else None


def _plot(rec: rr.RecordingStream, path: str, time: Array, values: Array, signal: str) -> tuple[float, float]:
    """Two lines, raw below corrected; returns the plot's limits."""
    at, lines = envelope(*break_at_gaps(time, values), ENVELOPE_POINTS)
    names = [f"{signal} raw", f"{signal} corrected"]
    send.lines(rec, path, at, send.flat(lines), names=names, colours=[ORANGE, SKY_BLUE])
    known = values[np.isfinite(values)]
    low, high = limits(float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    margin = 0.05 * (high - low)
    return low - margin, high + margin


def poles(diagnosis: Diagnosis) -> tuple[Array, Array]:
    """Times (w,) and complex poles (w, n + 1) in 1/s of each window's plant (coefficients a1, a2, ...) and
    sensor (``tau_*``), the sensor last; NaN where a window has none."""
    samples = diagnosis.samples
    orders = sorted(
        int(c.removeprefix("indicator.a"))
        for c in samples.columns
        if c[:11] == "indicator.a" and c[11:].isdigit()
    )
    sensor = next((c for c in samples.columns if c.startswith("indicator.tau_")), None)
    if not orders or sensor is None:
        return np.empty(0), np.empty((0, 0))
    a = np.stack([column(samples, f"indicator.a{i}") for i in orders], axis=1)
    tau = column(samples, sensor)
    out = np.full((samples.height, len(orders) + 1), np.nan, dtype=complex)
    for row in np.flatnonzero(np.isfinite(a).all(axis=1) & np.isfinite(tau)):
        out[row] = [*np.roots([1.0, *a[row]]), -1.0 / tau[row]]
    return column(samples, "time"), out


def place(pole: Array, unit: float) -> Array:
    """Where a pole is drawn: its angle kept, its distance from the origin in decades above ``unit``, shape
    (n, 2).

    >>> place(np.array([-10.0 + 0j]), 1.0).round(3).tolist()
    [[-20.828, -0.0]]
    """
    radius = DECADE * np.log10(1.0 + np.abs(pole) / unit)
    direction = pole / np.where(np.abs(pole) > 0.0, np.abs(pole), 1.0)
    return np.stack([radius * direction.real, -radius * direction.imag], axis=-1)


def _log_poles(
    rec: rr.RecordingStream, diagnosis: Diagnosis
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """All windows' poles, early dark to late bright, white those of the cursor's window; returns the box."""
    time, every = poles(diagnosis)
    known = np.isfinite(every).all(axis=1) if every.size else np.zeros(0, dtype=bool)
    if not known.any():
        return None
    time, every = time[known], every[known]
    unit = 10.0 ** np.floor(np.log10(np.abs(every).min()))
    placed = place(every, unit)
    far = int(np.ceil(np.log10(np.abs(every).max() / unit))) + 1
    _log_plane(rec, unit, far)
    colours = np.repeat(ramp(time), every.shape[1], axis=0)
    dots = rr.Points2D(placed.reshape(-1, 2), colors=colours, radii=rr.Radius.ui_points(2.0))
    rec.log(f"{POLES}/windows", dots, static=True)
    style = rr.Points2D.from_fields(colors=WHITE, radii=rr.Radius.ui_points(5.0))
    rec.log(f"{POLES}/now", style, static=True)
    columns = rr.Points2D.columns(positions=placed.reshape(-1, 2)).partition([every.shape[1]] * time.size)
    rec.send_columns(f"{POLES}/now", send.times(time), columns)
    reach = DECADE * far
    return (-1.08 * reach, 0.12 * reach), (-0.55 * reach, 0.55 * reach)


def _log_plane(rec: rr.RecordingStream, unit: float, far: int) -> None:
    """Half circles of equal distance from the origin, one a decade, and the axes."""
    turn = np.linspace(0.5 * np.pi, 1.5 * np.pi, 61)
    radii = DECADE * np.log10(1.0 + 10.0 ** np.arange(far + 1))
    circles = [np.stack([r * np.cos(turn), r * np.sin(turn)], axis=1) for r in radii]
    reach = DECADE * far
    axes = [
        np.array([[-reach, 0.0], [0.1 * reach, 0.0]]),
        np.array([[0.0, -0.5 * reach], [0.0, 0.5 * reach]]),
    ]
    rec.log(
        f"{POLES}/grid",
        rr.LineStrips2D([*circles, *axes], colors=DIM, radii=rr.Radius.ui_points(0.5)),
        static=True,
    )
    at = [[-r, 0.03 * reach] for r in radii]
    text = [f"{unit * 10.0**i:g}/s" for i in range(far + 1)]
    labels = rr.Points2D(at, labels=text, colors=GREY, radii=rr.Radius.ui_points(0.0), show_labels=True)
    rec.log(f"{POLES}/ticks", labels, static=True)
