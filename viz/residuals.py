"""Residuals with the bands that belong to them, what exceeds these, and when a fault was there or seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from ingest.log import Event
from stages.results import Diagnosis
from viz import send
from viz.colours import DETECTED, EXCEEDANCE, GREY, INJECTED, SKY_BLUE
from viz.lanes import truth
from viz.series import Array, break_at_gaps, changes, spans

WIDTH = 3.0
"""Half-width of the band in sigma, and the |z| beyond which a sample is marked."""
RESOLUTION = 0.01
"""A band is drawn anew where it moves by this share of sigma."""


@dataclass(frozen=True, kw_only=True)
class Residual:
    """One residual as drawn: where it is, and the half-height that shows all but rare outliers."""

    name: str
    title: str
    path: str
    height: float
    strength: float
    """Size of the mean z in alarm, or over the whole log without one."""


def names(samples: pl.DataFrame) -> list[tuple[str, str]]:
    """Name and column of each residual (``residual.<r>``) or indicator (``indicator.<r>``) of the samples."""
    columns = [c for c in samples.columns if c.startswith(("residual.", "indicator."))]
    return [(c.split(".", 1)[1], c) for c in columns]


def column(samples: pl.DataFrame, name: str) -> Array:
    """A numeric column of the samples as float64, shape (rows,), missing values NaN."""
    return samples[name].cast(pl.Float64).fill_null(float("nan")).to_numpy()


def log_residuals(rec: rr.RecordingStream, diagnosis: Diagnosis) -> list[Residual]:
    """Each residual below ``/residuals/<name>``, the most telling one first."""
    drawn = [_log_residual(rec, diagnosis, name, column) for name, column in names(diagnosis.samples)]
    return sorted(drawn, key=lambda r: -r.strength)


def _log_residual(rec: rr.RecordingStream, diagnosis: Diagnosis, name: str, source: str) -> Residual:
    samples = diagnosis.samples
    time, value = column(samples, "time"), column(samples, source)
    sigma, z = column(samples, f"sigma.{name}"), column(samples, f"z.{name}")
    path = send.entity("residuals", name)
    unit = diagnosis.units.get(name, "1")
    height = view_height(value, sigma)
    over = np.abs(z) > WIDTH

    _log_band(rec, f"{path}/band", time, value, sigma, z)
    _log_windows(rec, path, diagnosis, height)
    at, line = break_at_gaps(time, value[:, None])
    send.lines(rec, f"{path}/value", at, line, names=[f"{name} [{unit}]"], colours=[SKY_BLUE], width=1.0)
    send.points(
        rec, f"{path}/exceedances", time[over], value[over], name="|z| > 3", colour=EXCEEDANCE, size=1.5
    )
    telling = z[telling_rows(samples)]
    telling = telling[np.isfinite(telling)]
    strength = abs(float(telling.mean())) if telling.size else 0.0
    return Residual(name=name, title=f"{name} [{unit}]", path=path, height=height, strength=strength)


def telling_rows(samples: pl.DataFrame) -> NDArray[np.bool_]:
    """The rows in alarm or, without an alarm, all rows, shape (rows,)."""
    alarm = np.asarray(samples["detection"].to_numpy() > 0)
    return alarm if alarm.any() else np.ones(samples.height, dtype=bool)


def view_height(value: Array, sigma: Array) -> float:
    """Half-height of a plot: all values but outliers (three times the 99.5 % quantile), and the usual band.

    Sigma is many times larger while the system is far from steady state; that band may leave the picture.
    """
    size = np.abs(value[np.isfinite(value)])
    top = min(size.max(), 3.0 * np.quantile(size, 0.995)) if size.size else 0.0
    band = WIDTH * np.median(sigma[np.isfinite(sigma)]) if np.isfinite(sigma).any() else 0.0
    return 1.15 * float(max(top, band)) or 1.0


def _log_band(rec: rr.RecordingStream, path: str, time: Array, value: Array, sigma: Array, z: Array) -> None:
    """Centre ± 3 sigma from each change to the next; the centre is where z is zero: ``value - z sigma``."""
    rows, parts = break_at_gaps(time, np.stack([value - z * sigma, sigma], axis=1))
    parts[~(np.isfinite(parts).all(axis=1) & (parts[:, 1] > 0))] = np.nan
    scale = np.nanmedian(parts[:, 1]) if np.isfinite(parts).any() else 1.0
    steps = np.stack([parts[:, 0] / scale, np.log(parts[:, 1])], axis=1) / RESOLUTION
    known = np.nan_to_num(steps, nan=np.inf).round()
    at = np.union1d(changes(known[:, 0]), changes(known[:, 1]))
    send.band(rec, path, rows[at], parts[at, 0], WIDTH * parts[at, 1], name="± 3 sigma", colour=(*GREY, 255))


def _log_windows(rec: rr.RecordingStream, path: str, diagnosis: Diagnosis, height: float) -> None:
    """The time of detection shaded over the full height, that of injection as a strip along the top."""
    time = column(diagnosis.samples, "time")
    seen = spans(time, column(diagnosis.samples, "detection") > 0)
    _log_window(rec, f"{path}/detected", seen, 0.0, height, "detected", (*DETECTED, 110))
    end = float(time[-1]) if time.size else 0.0
    injected = [window(event, end) for event in truth(diagnosis.log)]
    if injected:
        _log_window(
            rec, f"{path}/injected", injected, 0.95 * height, 0.05 * height, "injected", (*INJECTED, 255)
        )


def window(event: Event, end: float) -> tuple[float, float]:
    """Start and end in s of an event, ``end`` where it has none."""
    return event.t_start, end if event.t_end is None else event.t_end


def _log_window(
    rec: rr.RecordingStream,
    path: str,
    windows: list[tuple[float, float]],
    centre: float,
    half: float,
    name: str,
    colour: tuple[int, int, int, int],
) -> None:
    edges = np.array(windows).reshape(-1)
    inside = np.arange(edges.size) % 2 == 0
    send.band(
        rec,
        path,
        edges,
        np.where(inside, centre, np.nan),
        np.full(edges.size, half),
        name=name,
        colour=colour,
    )
