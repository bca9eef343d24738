"""A quantity over the logs of a batch, one dot a log: as a small plot of the report, and in a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from viz.colours import GREY, Colour, hex_of
from viz.plane import Axes, frame, plane_view
from viz.series import Array

INCHES, COLUMNS = 9.6, 2
Line = tuple[tuple[tuple[float, float], ...], Colour]
"""Corners of a line, and its colour."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """``y`` of the logs from number ``first`` on, shape (logs,), NaN where it is not known, each log in its
    colour of ``shades``; ``bars``: what each may be off by; ``band``: where it usually is; ``lines``: corners
    of lines with their colour; ``mark``: a log that is pointed to, with its colour."""

    name: str
    unit: str
    y: Array
    shades: tuple[Colour, ...]
    first: int = 1
    bars: Array | None = None
    band: tuple[float, float] | None = None
    lines: tuple[Line, ...] = ()
    mark: tuple[int, Colour] | None = None

    @property
    def title(self) -> str:
        """Name and unit as they stand above the plot."""
        return f"{self.name} [{self.unit}]"

    @property
    def x(self) -> Array:
        """The numbers of the logs, shape (logs,)."""
        return np.arange(self.first, self.first + self.y.size, dtype=float)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which logs have a dot, shape (logs,)."""
        return np.isfinite(self.y)

    @property
    def ends(self) -> tuple[float, float]:
        """From the first log of all to the last, half a log to either side."""
        return 0.5, self.first + self.y.size - 0.5

    def uncertain(self) -> Iterator[tuple[float, float, float]]:
        """Place, lower and upper end of each bar."""
        if self.bars is not None:
            for x, y, half in zip(self.x, self.y, self.bars, strict=True):
                if np.isfinite(y + half):
                    yield float(x), float(y - half), float(y + half)

    def corners(self) -> Array:
        """Points that the picture must hold, shape (n, 2)."""
        points = [*zip(self.x[self.known], self.y[self.known], strict=True)]
        points += [(x, v) for v in self.band or () for x in self.ends]
        points += [(x, v) for x, low, high in self.uncertain() for v in (low, high)]
        points += [corner for line, _ in self.lines for corner in line]
        return np.array(points or [(x, 0.0) for x in self.ends])


def log_trace(rec: rr.RecordingStream, path: str, trace: Trace) -> rrb.View:
    """The trace below ``path`` of a recording, and its view."""
    axes = Axes.around(trace.corners())
    frame(rec, path, axes, "log", trace.unit)
    dots = axes.place(np.stack([trace.x, trace.y], axis=1)[trace.known])
    shown = [shade for shade, there in zip(trace.shades, trace.known, strict=True) if there]
    rec.log(f"{path}/dots", rr.Points2D(dots, colors=shown, radii=rr.Radius.ui_points(3.0)), static=True)
    strips = [("band", [[(x, v) for x in trace.ends] for v in trace.band or ()], GREY, 1.0)]
    strips += [("bars", [[(x, low), (x, high)] for x, low, high in trace.uncertain()], GREY, 0.7)]
    strips += [(f"line_{i}", [[*line]], colour, 1.0) for i, (line, colour) in enumerate(trace.lines)]
    if trace.mark is not None:
        strips.append(("mark", [[(trace.mark[0], v) for v in axes.y]], trace.mark[1], 1.0))
    for name, lines, colour, width in strips:
        if lines:
            placed = [axes.place(np.array(line)) for line in lines]
            strip = rr.LineStrips2D(placed, colors=colour, radii=rr.Radius.ui_points(width))
            rec.log(f"{path}/{name}", strip, static=True)
    return plane_view(path, f"{trace.title} over the logs")


def traces_plot(traces: Sequence[Trace], legend: Mapping[str, Colour]) -> Any:
    """A small plot for each trace; ``legend`` says whose colours those of the dots are."""
    from matplotlib.figure import Figure

    rows = -(-len(traces) // COLUMNS)
    height = 1.5 * rows + 0.5
    figure = Figure(figsize=(INCHES, height))
    axes = figure.subplots(rows, COLUMNS, sharex=True, squeeze=False)
    figure.subplots_adjust(
        left=0.06, right=0.99, top=1 - 0.25 / height, bottom=0.45 / height, hspace=0.4, wspace=0.14
    )
    for ax, trace in zip(axes.flat, traces, strict=False):
        _draw(ax, trace)
    for ax in axes.flat[len(traces) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("log")
    if len(legend) > 1:
        dots = [
            axes.flat[0].plot([], [], ".", color=hex_of(colour), label=name)[0]
            for name, colour in legend.items()
        ]
        figure.legend(
            handles=dots, loc="lower right", ncols=len(legend), borderaxespad=0.0, handletextpad=0.1
        )
    return figure


def _draw(ax: Any, trace: Trace) -> None:
    if trace.band is not None:
        ax.axhspan(*trace.band, color=hex_of(GREY), alpha=0.25, linewidth=0)
    for x, low, high in trace.uncertain():
        ax.plot([x, x], [low, high], color=hex_of(GREY), linewidth=1.0)
    shades = np.array([hex_of(shade) for shade in trace.shades])
    for shade in dict.fromkeys(shades.tolist()):
        mine = (shades == shade) & trace.known
        ax.plot(trace.x[mine], trace.y[mine], ".", color=shade, markersize=3.5)
    for line, colour in trace.lines:
        ax.plot(*zip(*line, strict=True), color=hex_of(colour), linewidth=1.6)
    if trace.mark is not None:
        ax.axvline(trace.mark[0], color=hex_of(trace.mark[1]), linewidth=1.2, linestyle=(0, (4, 3)))
    ax.set_xlim(*trace.ends)
    ax.margins(y=0.12)
    ax.set_title(trace.title)
