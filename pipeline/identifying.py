"""Identifying a linear model from a log: fitted on its first part, judged on the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import LogError
from ingest.log import Log
from stages.align import Align
from stages.stage import columns, transform
from stages.statespace import StateSpace
from stages.subspace import Identified, LagGram, Method, identify, lag_gram

Array = NDArray[np.float64]
GAP_STEPS = 1.5
SHOWN_ORDERS = 10


@dataclass(frozen=True, kw_only=True)
class Settings:
    """``order`` None: chosen by the criterion of the lags' canonical correlations. ``raster_s`` 0: the first
    output's own time stamps. ``training``: the share of the log that is fitted."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    order: int | None = None
    method: Method = "cva"
    horizon: int = 20
    raster_s: float = 0.0
    training: float = 0.7


def identify_log(log: Log, settings: Settings) -> dict[str, Any]:
    """What ``dynoscope identify`` prints, as plain values.

    Means are taken off. Stretches between gaps add up to one Gram matrix; the fit,
    |y - mean(y)|)`` in %, is that on the longest stretch held out, simulated from the best initial state
    and predicted one step ahead.

    Raises:
        LogError: a signal is not there, is constant, or there are too few samples.
    """
    names = (*settings.outputs, *settings.inputs)
    if twice := {n for n in names if names.count(n) > 1}:
        raise LogError(f"{', '.join(sorted(twice))}: named twice; a signal is input or output")
    aligned = columns(transform([Align(signals=names, raster_s=settings.raster_s)], log), ["time", *names])
    z = np.stack([aligned[n] for n in names], axis=1)
    time, z = aligned["time"][np.isfinite(z).all(axis=1)], z[np.isfinite(z).all(axis=1)]
    if time.size < 2:
        raise LogError(
            f"log {log.name!r}: {', '.join(names)} have no samples at the same times; give --raster"
        )
    dt, k = float(np.median(np.diff(time))), len(settings.outputs)
    split = int(settings.training * time.size)
    mean = z[:split].mean(axis=0)
    fitted = _stretches(time[:split], z[:split] - mean, dt)
    held_out = max(_stretches(time[split:], z[split:] - mean, dt), key=len)
    found = _identify(fitted, k, dt, settings)
    y, u = held_out[:, :k], held_out[:, k:]
    simulated = found.model.simulate(u, found.model.initial_state(y, u))
    return {
        "log": log.name, "inputs": list(settings.inputs), "outputs": list(settings.outputs),
        "method": settings.method, "sample_s": dt, "samples": split, "order": found.order,
        "poles": _poles(found.model),
        "gains": {
            o: dict(zip(settings.inputs, row, strict=True))
            for o, row in zip(settings.outputs, found.model.gains.tolist(), strict=True)
        },
        "singular_values": found.singular_values[:SHOWN_ORDERS].tolist(),
        "criterion": None if found.criterion is None else found.criterion[: SHOWN_ORDERS + 1].tolist(),
        "innovations_sd": np.sqrt(np.diag(found.model.R)).tolist(),
        "held_out": {
            "samples": len(held_out),
            "simulated_percent": _percent(settings, y, simulated),
            "predicted_percent": _percent(settings, y, found.model.predict(y, u)),
        },
    }  # fmt: skip


def _stretches(time: Array, z: Array, dt: float) -> list[Array]:
    """The samples between gaps, one array each."""
    breaks = np.flatnonzero(np.diff(time) > GAP_STEPS * dt) + 1
    return np.split(z, breaks)


def _identify(stretches: list[Array], outputs: int, dt: float, settings: Settings) -> Identified:
    long = [z for z in stretches if len(z) >= 4 * settings.horizon] or stretches[:1]
    total: LagGram | None = None
    for z in long:
        gram = lag_gram(z[:, :outputs], z[:, outputs:], settings.horizon)
        total = gram if total is None else total + gram
    assert total is not None
    return identify(total, dt, order=settings.order, method=settings.method)


def _poles(model: StateSpace) -> list[dict[str, float | None]]:
    """Each pole in 1/s, its time constant in s (None for one that is not stable) and damping ratio."""
    return [
        {
            "real": float(p.real), "imaginary": float(p.imag),
            "time_constant_s": -1.0 / float(p.real) if p.real < 0 else None,
            "damping": -float(p.real) / abs(p) if abs(p) else None,
        }
        for p in model.poles.tolist()
    ]  # fmt: skip


def _percent(settings: Settings, y: Array, predicted: Array) -> dict[str, float]:
    left = np.linalg.norm(y - predicted, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0)
    return dict(zip(settings.outputs, (100.0 * (1.0 - left)).tolist(), strict=True))
