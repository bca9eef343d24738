"""What a diagnosis's samples say in a few numbers: signatures, leads of evidence, distributions."""

from __future__ import annotations

import numpy as np
import polars as pl
from numpy.typing import NDArray

from stages.results import DETECTION, EVIDENCE, PAIR, PROBABILITY, Diagnosis
from viz.residuals import column, names, telling_rows
from viz.series import Array, at_times

CDF_POINTS = 120
UPSTREAM, DOWNSTREAM = "p_Bst", "p_Int"  # of the throttle


def signature(samples: pl.DataFrame) -> dict[str, float]:
    """Mean z of each residual in alarm or, without an alarm, over all rows; NaN where there is none.

    >>> frame = pl.DataFrame({"detection": [0, 1, 1], "residual.r": [0.0] * 3, "z.r": [0.5, 3.0, 5.0]})
    >>> signature(frame)
    {'r': 4.0}
    """
    rows = telling_rows(samples)
    return {name: _mean(column(samples, f"z.{name}")[rows]) for name, _ in names(samples)}


def telling(samples: pl.DataFrame) -> list[str]:
    """The residuals' names, the most telling one first."""
    strength = {n: abs(v) if np.isfinite(v) else -1.0 for n, v in signature(samples).items()}
    return sorted(strength, key=lambda n: -strength[n])


def _mean(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def regime_signature(samples: pl.DataFrame) -> tuple[list[int], list[str], Array]:
    """Regimes, residuals, and the mean z of each residual in each regime over the telling rows, shape
    (residuals, regimes); NaN where there are fewer than three samples."""
    shown = [name for name, _ in names(samples)]
    if "regime" not in samples.columns:
        return [], shown, np.empty((len(shown), 0))
    rows = telling_rows(samples)
    regime = samples["regime"].fill_null(-1).to_numpy()[rows]
    regimes = [int(r) for r in np.unique(regime) if r >= 0]
    table = np.full((len(shown), len(regimes)), np.nan)
    for i, name in enumerate(shown):
        z = column(samples, f"z.{name}")[rows]
        for j, r in enumerate(regimes):
            here = z[(regime == r) & np.isfinite(z)]
            if here.size >= 3:
                table[i, j] = here.mean()
    return regimes, shown, table


def leads(samples: pl.DataFrame, fault: str) -> dict[str, float]:
    """How much more evidence (log-likelihood ratio, nats) ``fault`` has than each other hypothesis where its
    own is greatest; ``none`` is the fault-free case, pairs count where they are likely. Empty where
    ``fault`` is no hypothesis."""
    own = EVIDENCE + fault
    if own not in samples.columns or not samples.height:
        return {}
    at = samples.row(samples[own].cast(pl.Float64).fill_nan(None).arg_max() or 0, named=True)
    others = {k.removeprefix(EVIDENCE): v for k, v in at.items() if k.startswith(EVIDENCE) and k != own}
    others = {k: v for k, v in others.items() if PAIR not in k or (at.get(PROBABILITY + k) or 0.0) > 0.02}
    known = {"none": 0.0, **{k: float(v) for k, v in others.items() if v is not None and np.isfinite(v)}}
    return {k: float(at[own]) - v for k, v in known.items()} if at[own] is not None else {}


def cdf(values: Array, points: int = CDF_POINTS) -> tuple[Array, Array]:
    """The empirical cumulative distribution of the finite values at about ``points`` of them.

    >>> x, share = cdf(np.array([3.0, 1.0, 2.0, np.nan]))
    >>> x.tolist(), share.round(2).tolist()
    ([1.0, 2.0, 3.0], [0.33, 0.67, 1.0])
    """
    x = np.sort(values[np.isfinite(values)])
    rows = np.unique(np.linspace(0, max(x.size - 1, 0), points).astype(int)) if x.size else np.empty(0, int)
    return x[rows], (rows + 1.0) / max(x.size, 1)


def in_alarm(samples: pl.DataFrame) -> NDArray[np.bool_]:
    """The rows in alarm, shape (rows,)."""
    return np.asarray(samples[DETECTION].to_numpy() > 0)


def abscissa(diagnosis: Diagnosis) -> tuple[str, Array] | None:
    """What residuals are drawn against, by name and value at each row: the pressure ratio across the throttle
    (dissertation, figure 5.13), else the first signal of the operating map, else nothing."""
    log, time = diagnosis.log, column(diagnosis.samples, "time")
    if {UPSTREAM, DOWNSTREAM} <= log.signals.keys():
        up, down = (at_times(log, name, time) for name in (UPSTREAM, DOWNSTREAM))
        with np.errstate(divide="ignore", invalid="ignore"):
            return f"pressure ratio {UPSTREAM} / {DOWNSTREAM}", up / down
    plane = diagnosis.operating_map
    return (plane.x_label, plane.x) if plane is not None and plane.x.size == time.size else None
