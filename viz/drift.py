"""How the residuals of a batch have moved from log to log, as a part of its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from viz.colours import DETECTED, GREY, ORANGE, hex_of, of_index
from viz.series import Array
from viz.svg import style, themed

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


def drift_part(
    logs: Sequence[str],
    vehicles: Sequence[str | None],
    moved: Sequence[Moved],
    advice: Sequence[Mapping[str, str]],
) -> str:
    """Advice and plots as HTML."""
    said = [f"since {a['since']}: {a['why']}: {a['do']}" for a in advice]
    listed = "".join(
        f"<li>{escape(text)}</li>" for text in said or ["nothing has moved; no reason to retrain"]
    )
    note = (
        f"{len(logs)} logs in the order of their start, means over samples near steady state. "
        f"Grey: ±{LIMIT:g} times the noise between logs about the first level; line: levels; "
        "dashed: where a change would have been noticed."
    )
    with style():
        drawing = themed(drift_plot(vehicles, moved)) if moved else ""
    head = '<h2 id="drift">Drift from log to log</h2>'
    return f'{head}<ul>{listed}</ul><p class="soft">{note}</p>{drawing}'


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
    first = one.levels[0][2] / one.sigma if one.levels else 0.0
    half = LIMIT * one.noise / one.sigma
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
