"""Drive cycles: speed over time, from the package data or a user's CSV."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.errors import LogError, did_you_mean

__all__ = ["CYCLES", "load_cycle", "resample_cycle"]

CYCLES = ("ftp75", "hwfet", "nedc", "udds", "us06", "wltc_3b")
HOT_START_S = 505  # FTP-75 ends as it began, 40 CFR 1066.815
_TIME = ("time", "t", "time_s", "cycsecs")
_SPEED = {"cycmps": 1.0, "speed_mps": 1.0, "v_veh": 1 / 3.6, "speed_kmh": 1 / 3.6, "speed_mph": 0.44704}


def load_cycle(cycle: str | Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time (s, from 0) and speed (m/s) of a built-in cycle by name, or of a CSV file.

    The CSV has a time column (``time``, ``t``, ``time_s``) and a speed column whose name gives the unit:
    ``v_Veh`` or ``speed_kmh`` (km/h), ``speed_mps`` (m/s), ``speed_mph`` (mph).

    Raises:
        LogError: no such cycle or file, a column is missing, or times that do not rise, or a negative speed.
    """
    if str(cycle) == "ftp75":  # the soak between its two parts is left out
        udds = load_cycle("udds")[1]
        speed = np.concatenate([udds, udds[1 : HOT_START_S + 1]])
        return np.arange(len(speed), dtype=np.float64), speed
    folder = files("ingest") / "cycles"
    if str(cycle) == "nedc":
        speed = np.array((folder / "nedc.txt").read_text().split(), dtype=np.float64) / 3.6
        return np.arange(len(speed), dtype=np.float64), speed
    if str(cycle) in CYCLES:
        return _columns(pl.read_csv((folder / f"{cycle}.csv").read_bytes()), str(cycle))
    return _columns(_read_csv(Path(cycle)), str(cycle))


def _read_csv(path: Path) -> pl.DataFrame:
    if not path.is_file():
        raise LogError(
            f"cycle {str(path)!r} is neither a built-in cycle nor a file; {did_you_mean(str(path), CYCLES)}"
        )
    try:
        return pl.read_csv(path)
    except pl.exceptions.PolarsError as error:
        raise LogError(f"cycle {path}: not a CSV file of time and speed ({error})") from error


def _columns(frame: pl.DataFrame, source: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    names = {c.strip().casefold(): c for c in frame.columns}
    time_name = next((names[n] for n in _TIME if n in names), None)
    speed_name = next((n for n in _SPEED if n in names), None)
    if time_name is None or speed_name is None:
        raise LogError(
            f"cycle {source}: columns {frame.columns}; expected a time column ({', '.join(_TIME)}) "
            f"and a speed column ({', '.join(_SPEED)})"
        )
    numbers = frame.select(time_name, names[speed_name]).cast(pl.Float64, strict=False).drop_nulls()
    time, speed = numbers.to_numpy().T
    if len(numbers) < max(2, frame.height):
        raise LogError(
            f"cycle {source}: {len(numbers)} of {frame.height} rows are numbers; expected all, at least 2"
        )
    if not (np.diff(time) > 0).all() or not (speed >= 0).all():
        raise LogError(f"cycle {source}: time must rise from row to row and speed must not be negative")
    return time - time[0], speed * _SPEED[speed_name]


def resample_cycle(
    time: NDArray[np.float64], speed: NDArray[np.float64], rate_hz: float, duration_s: float | None
) -> NDArray[np.float64]:
    """Speed at ``rate_hz`` for ``duration_s``, the cycle cut or repeated; None: once through it.

    >>> resample_cycle(np.array([0.0, 1.0]), np.array([0.0, 2.0]), 2.0, 2.0)
    array([0., 1., 0., 1.])
    """
    length = float(time[-1])
    n = round((length if duration_s is None else duration_s) * rate_hz)
    t = np.arange(n) / rate_hz
    return np.interp(t if duration_s is None or duration_s <= length else np.mod(t, length), time, speed)
