"""How the residuals of a batch have moved from log to log, in its report and in its recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from viz import send
from viz.colours import DETECTED, GREY, ORANGE, Colour, hex_of, of_index
from viz.plane import HEIGHT, WIDTH, Axes, frame
from viz.series import Array
from viz.svg import style, themed

ROOT = "/drift"
INCHES, COLUMNS = 9.6, 2
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
    f"logs in the order of their start, means over samples near steady state. Grey: ±{LIMIT:g} times the "
    "noise between logs about the first level; orange: levels; yellow: where a change would be noticed."
)


def drift_part(drift: Drifted) -> str:
    """Advice and plots as HTML."""
    listed = "".join(f"<li>{escape(text)}</li>" for text in drift.words())
    with style():
        drawing = themed(drift_plot(drift.vehicles, drift.moved)) if drift.moved else ""
    head = '<h2 id="drift">Drift from log to log</h2>'
    return f'{head}<ul>{listed}</ul><p class="soft">{len(drift.vehicles)} {LEGEND}</p>{drawing}'


def log_drift(rec: rr.RecordingStream, drift: Drifted) -> list[rrb.View]:
    """The same below ``/drift`` of a recording; returns the views."""
    text = "## Drift from log to log\n\n" + "\n".join(f"- {line}" for line in drift.words())
    send.markdown(rec, f"{ROOT}/advice", f"{text}\n\n{len(drift.vehicles)} {LEGEND}")
    views: list[rrb.View] = [rrb.TextDocumentView(origin=f"{ROOT}/advice", name="Advice")]
    names = list(dict.fromkeys(drift.vehicles))
    for one in drift.moved:
        path = send.entity("drift", "plots", one.residual)
        _log_moved(rec, path, [of_index(names.index(v)) for v in drift.vehicles], one)
        views.append(
            rrb.Spatial2DView(
                origin=path, name=f"mean of {one.residual} [sigma] over the logs",
                background=rrb.Background(color=(16, 17, 20)),
                visual_bounds=rrb.VisualBounds2D(x_range=[-10, WIDTH + 5], y_range=[-HEIGHT - 9, 12]),
            )
        )  # fmt: skip
    return views


def _log_moved(rec: rr.RecordingStream, path: str, colours: list[Colour], one: Moved) -> None:
    x, y = np.arange(1.0, one.means.size + 1), one.means / one.sigma
    first, half = one.usual()
    edges = [[0.5, first - half], [x.size + 0.5, first + half]] if np.isfinite(half) else []
    axes = Axes.around(np.array([*zip(x, y, strict=True), *edges]))
    frame(rec, path, axes, "log", "sigma")
    known = np.isfinite(y)
    shown = [colour for colour, there in zip(colours, known, strict=True) if there]
    dots = rr.Points2D(
        axes.place(np.stack([x, y], axis=1)[known]), colors=shown, radii=rr.Radius.ui_points(3.0)
    )
    rec.log(f"{path}/means", dots, static=True)
    strips = {
        "levels": ([[[a + 0.5, v / one.sigma], [b + 1.5, v / one.sigma]] for a, b, v in one.levels], ORANGE),
        "usual": ([[[0.5, v], [x.size + 0.5, v]] for _, v in edges], GREY),
        "noticed": ([] if one.noticed is None else [[[one.noticed + 1.0, v] for v in axes.y]], DETECTED),
    }  # fmt: skip
    for name, (lines, colour) in strips.items():
        if lines:
            placed = [axes.place(np.array(line)) for line in lines]
            strip = rr.LineStrips2D(placed, colors=colour, radii=rr.Radius.ui_points(1.5))
            rec.log(f"{path}/{name}", strip, static=True)


def drift_plot(vehicles: Sequence[str | None], moved: Sequence[Moved]) -> Any:
    """A small plot for each residual: its mean in each log over the logs, in sigma, coloured by vehicle."""
    from matplotlib.figure import Figure

    rows = -(-len(moved) // COLUMNS)
    height = 1.5 * rows + 0.5
    figure = Figure(figsize=(INCHES, height))
    axes = figure.subplots(rows, COLUMNS, sharex=True, squeeze=False)
    figure.subplots_adjust(
        left=0.06, right=0.99, top=1 - 0.25 / height, bottom=0.45 / height, hspace=0.4, wspace=0.14
    )
    names = list(dict.fromkeys(vehicles))
    for ax, one in zip(axes.flat, moved, strict=False):
        _moved(ax, vehicles, names, one)
    for ax in axes.flat[len(moved) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("log")
    if len(names) > 1:
        axes.flat[0].legend(loc="upper left", ncols=len(names), borderaxespad=0.2, handletextpad=0.1)
    return figure


def _moved(ax: Any, vehicles: Sequence[str | None], names: Sequence[str | None], one: Moved) -> None:
    x, y = np.arange(1, one.means.size + 1), one.means / one.sigma
    first, half = one.usual()
    if np.isfinite(half):
        ax.axhspan(first - half, first + half, color=hex_of(GREY), alpha=0.25, linewidth=0)
    for i, vehicle in enumerate(names):
        mine = np.array([v == vehicle for v in vehicles])
        ax.plot(
            x[mine], y[mine], ".", color=hex_of(of_index(i)), markersize=3.5, label=vehicle or "no vehicle"
        )
    for start, end, level in one.levels:
        ax.plot([start + 0.5, end + 1.5], [level / one.sigma] * 2, color=hex_of(ORANGE), linewidth=1.6)
    if one.noticed is not None:
        ax.axvline(one.noticed + 1, color=hex_of(DETECTED), linewidth=1.2, linestyle=(0, (4, 3)))
    ax.set_title(f"mean of {one.residual} [sigma]")
