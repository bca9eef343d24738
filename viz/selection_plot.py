"""What the inputs of a model were selected on, as one figure of the report; see :mod:`viz.selection`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.results import RESIDUAL_EDGES, Chosen
from viz.colours import BLUE, GREY, ORANGE, SKY_BLUE, VERMILLION, hex_of
from viz.selection import COURSE, RESIDUAL, SPECTRUM, frequencies, normal, titles
from viz.svg import style

INCHES = 9.6
NAMED = 24
"""Candidates at most that are named."""


def selection_plot(one: Chosen) -> Any:
    """Correlation map, best genes, course of the search, distribution and spectrum of the residual."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(INCHES, 5.4))
    grid = figure.add_gridspec(
        2, 6, height_ratios=[1.5, 1.0], left=0.1, right=0.985, top=0.93, bottom=0.09, hspace=0.5, wspace=1.1
    )
    _correlation(figure.add_subplot(grid[0, :3]), one)
    _genes(figure.add_subplot(grid[0, 3:]), one)
    words, blue, grey = titles(one), hex_of(SKY_BLUE), hex_of(GREY)
    course, residual, spectrum = (figure.add_subplot(grid[1, 2 * i : 2 * i + 2]) for i in range(3))
    course.plot(one.history, color=blue, drawstyle="steps-post")
    course.set_xlabel("genes, generations or starts")
    residual.stairs(one.residual, RESIDUAL_EDGES, color=blue)
    x = np.linspace(RESIDUAL_EDGES[0], RESIDUAL_EDGES[-1], 81)
    residual.plot(x, normal(x), color=grey)
    residual.set_xlabel("residual [sd]")
    spectrum.plot(frequencies(one), one.spectrum, color=blue)
    spectrum.axhline(1.0, color=grey)
    spectrum.set_ylim(0.0, None)
    spectrum.set_xlabel("frequency [1/sample]")
    for ax, picture in ((course, COURSE), (residual, RESIDUAL), (spectrum, SPECTRUM)):
        ax.set_title(words[picture].split(" · ")[0])
    return figure


def _correlation(ax: Any, one: Chosen) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    shades = LinearSegmentedColormap.from_list("", [hex_of(BLUE), "#ffffff00", hex_of(VERMILLION)])
    ax.imshow(np.array(one.correlation), cmap=shades, vmin=-1, vmax=1, interpolation="nearest")
    names = (*one.candidates, one.output)
    shown = range(len(names)) if len(names) <= NAMED else [i for i, n in enumerate(names) if n in one.taken]
    ax.set_yticks(list(shown), [names[i] for i in shown])
    ax.set_xticks([])
    for i, label in zip(shown, ax.get_yticklabels(), strict=True):
        label.set_fontsize(6.0)
        label.set_fontweight("bold" if names[i] in one.taken else "normal")
    ax.grid(False)
    ax.set_title(f"Correlation of the candidates, {one.output} last · bold: selected")


def _genes(ax: Any, one: Chosen) -> None:
    rank = np.arange(1, len(one.scores) + 1)
    ax.plot(rank, one.scores, ".-", color=hex_of(SKY_BLUE))
    ax.plot(rank[:1], one.scores[:1], "o", color=hex_of(ORANGE))
    ax.set_xlabel("rank")
    ax.set_title(f"{one.criterion} of the best {len(rank)} genes")
    ax.margins(x=0.03)


def write_selection_plot(one: Chosen, path: Path) -> None:
    """The figure as an SVG file of its own."""
    with style():
        figure = selection_plot(one)
        figure.savefig(path, format="svg", facecolor="white", metadata={"Date": None})
