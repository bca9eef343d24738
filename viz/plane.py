"""Pictures in a plane: a frame with ticks and names, points at their places, numbers on a field.

Rerun has no plot of one value against another, so these are drawn by hand in its 2D view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from viz.colours import BLUE, DIM, VERMILLION, WHITE, Colour
from viz.series import Array, limits, tick_step

WIDTH, HEIGHT = 100.0, 75.0
Range = tuple[float, float]
FRAMED: tuple[Range, Range] = (-10.0, WIDTH + 5.0), (-HEIGHT - 9.0, 15.0)
"""Limits across and downwards of what :func:`frame` draws."""
BACKGROUND = (16, 17, 20)
TICKS: Colour = (215, 215, 215)  # read on the dark boxes of the dark theme and the grey ones of the light


@dataclass(frozen=True, kw_only=True)
class Axes:
    """The rectangle of the data that fills the picture; pictures count y downwards."""

    x: tuple[float, float]
    y: tuple[float, float]

    @classmethod
    def around(cls, points: Array) -> Axes:
        """Round limits around the finite ones of ``points``, shape (n, 2)."""
        finite = points[np.isfinite(points).all(axis=1)]
        finite = finite if finite.size else np.zeros((1, 2))
        (x0, y0), (x1, y1) = finite.min(axis=0), finite.max(axis=0)
        return cls(x=limits(x0, x1), y=limits(y0, y1))

    def place(self, points: Array) -> Array:
        """Data (n, 2) to picture coordinates (n, 2)."""
        x = (points[:, 0] - self.x[0]) / (self.x[1] - self.x[0]) * WIDTH
        y = (points[:, 1] - self.y[0]) / (self.y[1] - self.y[0]) * -HEIGHT
        return np.stack([x, y], axis=1)


def frame(rec: rr.RecordingStream, path: str, axes: Axes, across: str, up: str) -> None:
    """Grid, ticks and the names of both axes, below ``path``."""
    grid, at, words = [*_box()], [], []
    for low, high, horizontal in ((*axes.x, True), (*axes.y, False)):
        step = tick_step(low, high)
        for value in np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1.0) * step:
            share = (value - low) / (high - low)
            x, y = share * WIDTH, -share * HEIGHT
            grid.append([[x, 0.0], [x, -HEIGHT]] if horizontal else [[0.0, y], [WIDTH, y]])
            at.append([x, 2.5] if horizontal else [-3.5, y - 1.0])
            words.append(f"{0.0 if abs(value) < step / 1e6 else value:.6g}")
    rec.log(f"{path}/grid", rr.LineStrips2D(grid, colors=DIM, radii=rr.Radius.ui_points(0.5)), static=True)
    text(rec, f"{path}/ticks", at, words, TICKS)
    text(rec, f"{path}/axes", [[WIDTH / 2, 7.5], [8.0, -HEIGHT - 4.5]], [across, up], WHITE)


def plane_view(
    path: str, title: str, bounds: tuple[Range, Range] = FRAMED, overrides: Mapping[Any, Any] | None = None
) -> rrb.Spatial2DView:
    """The view of a picture below ``path``."""
    across, down = bounds
    return rrb.Spatial2DView(
        origin=path, name=title, background=rrb.Background(color=BACKGROUND), overrides=overrides,
        visual_bounds=rrb.VisualBounds2D(x_range=list(across), y_range=list(down)),
    )  # fmt: skip


def _box() -> list[list[list[float]]]:
    """The edges of the picture."""
    corners = [[0.0, 0.0], [WIDTH, 0.0], [WIDTH, -HEIGHT], [0.0, -HEIGHT], [0.0, 0.0]]
    return [[a, b] for a, b in pairwise(corners)]


def text(
    rec: rr.RecordingStream,
    path: str,
    at: Sequence[Sequence[float]] | Array,
    words: Sequence[str],
    colour: Colour,
) -> None:
    """Words at their places."""
    radii = rr.Radius.ui_points(0.0)
    rec.log(path, rr.Points2D(at, labels=words, colors=colour, radii=radii, show_labels=True), static=True)


CELL, ROW = 12, 8
"""Width and height of a field of :func:`matrix`."""


def matrix(
    rec: rr.RecordingStream, path: str, values: Array, rows: Sequence[str], heads: Sequence[str], limit: float
) -> None:
    """Numbers (rows, heads) on fields from blue (below zero) to vermillion (above), ``limit`` as deep as it
    gets."""
    share = np.clip(np.nan_to_num(values) / limit, -1.0, 1.0)[..., None]
    ground = np.array((34.0, 37.0, 41.0))
    colour = ground + np.abs(share) * (np.where(share > 0, np.array(VERMILLION), np.array(BLUE)) - ground)
    fields = np.repeat(np.repeat(colour, ROW, axis=0), CELL, axis=1).round().astype(np.uint8)
    fields[:, ::CELL], fields[::ROW] = 16, 16
    rec.log(f"{path}/fields", rr.Image(fields), static=True)
    places = np.array([[(j + 0.5) * CELL, (i + 0.5) * ROW - 1.5] for i, j in np.ndindex(values.shape)])
    shown = np.flatnonzero(np.isfinite(values.ravel()))
    text(rec, f"{path}/numbers", places[shown], [number(v) for v in values.ravel()[shown]], WHITE)
    text(rec, f"{path}/rows", [[-CELL, (i + 0.5) * ROW - 1.5] for i in range(len(rows))], rows, WHITE)
    text(rec, f"{path}/heads", [[(j + 0.5) * CELL, -ROW] for j in range(len(heads))], heads, WHITE)


def number(value: float) -> str:
    """
    >>> number(-0.04), number(3.21), number(14.6)
    ('0', '3.2', '15')
    """
    return f"{value:.0f}" if abs(value) >= 9.95 else f"{value:.1f}".replace("-0.0", "0").removesuffix(".0")
