"""How the residuals of a batch have moved from log to log, in its report and in its recording."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from viz import send
from viz.colours import DETECTED, ORANGE, Colour, of_index
from viz.over_logs import Trace, log_trace, traces_plot
from viz.series import Array
from viz.svg import style, themed

ROOT = "/drift"
LIMIT = 3.0
"""Half-width of the band, in the noise between logs about the first level."""


@dataclass(frozen=True, kw_only=True)
class Moved:
    """A residual's mean in each log, shape (logs,), NaN where there is none; its spread ``sigma`` within a
    log and the ``noise`` between logs; the first and last log of each level; the log at which the cusum
    noticed a change."""

    residual: str
    means: Array
    sigma: float
    noise: float
    levels: tuple[tuple[int, int, float], ...]
    noticed: int | None

    def usual(self) -> tuple[float, float]:
        """The first level and the half-width of the band about it, in sigma."""
        return (self.levels[0][2] if self.levels else 0.0) / self.sigma, LIMIT * self.noise / self.sigma


@dataclass(frozen=True, kw_only=True)
class Drifted:
    """The drift of a batch: the vehicle of each log in order of time, its residuals, and what follows."""

    vehicles: tuple[str | None, ...]
    moved: tuple[Moved, ...]
    advice: tuple[str, ...]

    def words(self) -> list[str]:
        """What follows, in sentences."""
        return [*self.advice] or ["nothing has moved; no reason to retrain"]


LEGEND = (
    "logs in the order of their start, means over samples near steady state and without alarm. Grey: "
    f"±{LIMIT:g} times the noise between logs about the first level; orange: levels; yellow: where a change "
    "would be noticed."
)


def drift_part(drift: Drifted) -> str:
    """Advice and plots as HTML."""
    listed = "".join(f"<li>{escape(text)}</li>" for text in drift.words())
    legend, traces = _traces(drift)
    with style():
        drawing = themed(traces_plot(traces, legend)) if traces else ""
    head = '<h2 id="drift">Drift from log to log</h2>'
    return f'{head}<ul>{listed}</ul><p class="soft">{len(drift.vehicles)} {LEGEND}</p>{drawing}'


def log_drift(rec: rr.RecordingStream, drift: Drifted) -> list[rrb.View]:
    """The same below ``/drift`` of a recording; returns the views."""
    text = "## Drift from log to log\n\n" + "\n".join(f"- {line}" for line in drift.words())
    send.markdown(rec, f"{ROOT}/advice", f"{text}\n\n{len(drift.vehicles)} {LEGEND}")
    views: list[rrb.View] = [rrb.TextDocumentView(origin=f"{ROOT}/advice", name="Advice")]
    for one, trace in zip(drift.moved, _traces(drift)[1], strict=True):
        views.append(log_trace(rec, send.entity("drift", "plots", one.residual), trace))
    return views


def _traces(drift: Drifted) -> tuple[dict[str, Colour], list[Trace]]:
    """The colour of each vehicle, and a trace of each residual."""
    names = list(dict.fromkeys(drift.vehicles))
    shades = tuple(of_index(names.index(v)) for v in drift.vehicles)
    legend = {name or "no vehicle": of_index(i) for i, name in enumerate(names)}
    return legend, [_trace(one, shades) for one in drift.moved]


def _trace(one: Moved, shades: tuple[Colour, ...]) -> Trace:
    first, half = one.usual()
    levels = [((a + 0.5, v / one.sigma), (b + 1.5, v / one.sigma)) for a, b, v in one.levels]
    return Trace(
        name=f"mean of {one.residual}", unit="sigma", y=one.means / one.sigma, shades=shades,
        band=(first - half, first + half) if np.isfinite(half) else None,
        lines=tuple((level, ORANGE) for level in levels),
        mark=None if one.noticed is None else (one.noticed + 1, DETECTED),
    )  # fmt: skip
