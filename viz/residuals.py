"""Residuals with the bands that belong to them, what exceeds these, and when a fault was there or seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from stages.results import Diagnosis
from viz import send
from viz.colours import DETECTED, EXCEEDANCE, GREY, INJECTED, SKY_BLUE
from viz.lanes import truth
from viz.series import Array, break_at_gaps, changes, numbers, spans, union

WIDTH = 3.0
"""Half-width of the band in sigma, and the |z| beyond which a sample is marked."""
STRIP = 0.05
"""Height of the strip that shows injection, as a share of the plot's."""
RESOLUTION = 0.01
"""A band is drawn anew where it moves by this share of sigma."""


@dataclass(frozen=True, kw_only=True)
class Residual:
    """One residual as drawn: where it is, and the limits that show all but rare outliers."""

    name: str
    title: str
    path: str
    range: tuple[float, float]
    strength: float
    """Size of the mean z in alarm, or over the whole log without one."""


def names(samples: pl.DataFrame) -> list[tuple[str, str]]:
    """Name and column of each residual (``residual.<r>``) or indicator (``indicator.<r>``) of the samples."""
    columns = [c for c in samples.columns if c.startswith(("residual.", "indicator."))]
    return [(c.split(".", 1)[1], c) for c in columns]


def column(samples: pl.DataFrame, name: str) -> Array:
    """A numeric column of the samples as float64, shape (rows,), missing values NaN."""
    return numbers(samples[name])


def log_residuals(rec: rr.RecordingStream, diagnosis: Diagnosis) -> list[Residual]:
    """Each residual below ``/residuals/<name>``, the most telling one first."""
    drawn = [_log_residual(rec, diagnosis, name, column) for name, column in names(diagnosis.samples)]
    return sorted(drawn, key=lambda r: -r.strength)


def _log_residual(rec: rr.RecordingStream, diagnosis: Diagnosis, name: str, source: str) -> Residual:
    samples = diagnosis.samples
    time, value = column(samples, "time"), column(samples, source)
    sigma, z = column(samples, f"sigma.{name}"), column(samples, f"z.{name}")
    centre = value - z * sigma  # where z is zero: 0 for a residual, the healthy value for an indicator
    over = np.abs(z) > WIDTH
    meant = (
        diagnosis.about.residuals.get(name) if diagnosis.about and source.startswith("indicator.") else None
    )
    title = f"{name}{f': {meant}' if meant else ''} [{diagnosis.units.get(name) or '1'}]"
    path = send.entity("residuals", name)
    shown = view_range(value, centre, sigma)

    log_band(rec, f"{path}/band", time, centre, sigma)
    _log_windows(rec, path, diagnosis, shown)
    at, line = break_at_gaps(time, value[:, None])
    send.lines(rec, f"{path}/value", at, line, names=[title], colours=[SKY_BLUE], width=1.0)
    red = f"|z| > {WIDTH:g}"
    send.points(rec, f"{path}/exceedances", time[over], value[over], name=red, colour=EXCEEDANCE, size=1.5)
    telling = z[telling_rows(samples)]
    telling = telling[np.isfinite(telling)]
    strength = abs(float(telling.mean())) if telling.size else 0.0
    return Residual(name=name, title=title, path=path, range=shown, strength=strength)


def telling_rows(samples: pl.DataFrame) -> NDArray[np.bool_]:
    """The rows in alarm or, without an alarm, all rows, shape (rows,)."""
    alarm = np.asarray(samples["detection"].to_numpy() > 0)
    return alarm if alarm.any() else np.ones(samples.height, dtype=bool)


def view_range(value: Array, centre: Array, sigma: Array) -> tuple[float, float]:
    """Limits about the usual centre that show all values but outliers, and the usual band.

    Outliers are three times farther than 99.5 % of the values. Sigma is many times larger while the system is
    far from steady state; that band may leave the picture.
    """
    known = np.isfinite(value) & np.isfinite(centre) & np.isfinite(sigma)
    if not known.any():
        return -1.0, 1.0
    middle, band = float(np.median(centre[known])), WIDTH * float(np.median(sigma[known]))
    away = np.abs(value[known] - middle)
    half = 1.15 * max(min(float(away.max()), 3.0 * float(np.quantile(away, 0.995))), band) or 1.0
    return middle - half, middle + half


def log_band(
    rec: rr.RecordingStream,
    path: str,
    time: Array,
    centre: Array,
    sigma: Array,
    name: str = f"± {WIDTH:g} sigma",
    colour: tuple[int, int, int, int] = (*GREY, 200),
) -> None:
    """Centre ± 3 sigma from each change to the next."""
    rows, parts = break_at_gaps(time, np.stack([centre, sigma], axis=1))
    parts[~(np.isfinite(parts).all(axis=1) & (parts[:, 1] > 0))] = np.nan
    scale = np.nanmedian(parts[:, 1]) if np.isfinite(parts).any() else 1.0
    steps = np.stack([parts[:, 0] / scale, np.log(parts[:, 1])], axis=1) / RESOLUTION
    known = np.nan_to_num(steps, nan=np.inf).round()
    at = np.union1d(changes(known[:, 0]), changes(known[:, 1]))
    send.band(rec, path, rows[at], parts[at, 0], WIDTH * parts[at, 1], name=name, colour=colour)


def _log_windows(
    rec: rr.RecordingStream, path: str, diagnosis: Diagnosis, shown: tuple[float, float]
) -> None:
    """The time of detection shaded over the full height, that of injection as a strip along the top."""
    low, high = shown
    time = column(diagnosis.samples, "time")
    seen = spans(time, column(diagnosis.samples, "detection") > 0)
    _log_window(rec, f"{path}/detected", seen, (low, high), "detected", (*DETECTED, 80))
    end = float(time[-1]) if time.size else 0.0
    events = truth(diagnosis.log)
    injected = union([(e.t_start, end if e.t_end is None else e.t_end) for e in events])
    if injected:
        strip = (high - STRIP * (high - low), high)
        _log_window(rec, f"{path}/injected", injected, strip, "injected", (*INJECTED, 255))


def _log_window(
    rec: rr.RecordingStream,
    path: str,
    windows: list[tuple[float, float]],
    rows: tuple[float, float],
    name: str,
    colour: tuple[int, int, int, int],
) -> None:
    """Rectangles over ``windows`` (s) between the two values of ``rows``."""
    edges = np.array(windows).reshape(-1)
    inside = np.arange(edges.size) % 2 == 0
    centre = np.where(inside, (rows[0] + rows[1]) / 2.0, np.nan)
    half = np.full(edges.size, (rows[1] - rows[0]) / 2.0)
    send.band(rec, path, edges, centre, half, name=name, colour=colour)
