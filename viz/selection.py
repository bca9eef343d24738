"""What the inputs of a model were selected on: correlations, the search's course, the best genes, and what a
model of the best one leaves (dissertation, figures 4.2 to 4.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from stages.results import RESIDUAL_EDGES, Chosen
from viz.colours import BLUE, GREY, ORANGE, SKY_BLUE, VERMILLION, WHITE
from viz.plane import FRAMED, Axes, frame, plane_view, text
from viz.send import entity
from viz.series import Array

SELECTION = "selection"
CORRELATION, COURSE, LANDSCAPE, RESIDUAL, SPECTRUM = (
    "correlation", "course", "landscape", "residual", "spectrum",
)  # fmt: skip
FIELD = 8
"""Width of a field of the correlation map."""
NAMED = 16
"""Candidates and output that have room for a name each."""
GROUND = (34.0, 37.0, 41.0)


def log_selections(rec: rr.RecordingStream, chosen: Sequence[Chosen]) -> None:
    """The pictures of every selection below ``/selection/<model>``."""
    for one in chosen:
        _log_correlation(rec, _path(one, CORRELATION), one)
        _log_genes(rec, _path(one, LANDSCAPE), one)
        _log_course(rec, _path(one, COURSE), one)
        edges, density = np.repeat(RESIDUAL_EDGES, 2)[1:-1], np.repeat(one.residual, 2)
        bars = np.stack([edges, density], axis=1)
        _log_line(rec, _path(one, RESIDUAL), bars, "residual [sd]", "density", normal(edges))
        power = np.stack([frequencies(one), one.spectrum], axis=1)
        words = "frequency [1/sample]", "power, white = 1"
        _log_line(rec, _path(one, SPECTRUM), power, *words, np.ones(len(power)))


def selection_tabs(chosen: Sequence[Chosen]) -> list[rrb.Container]:
    """A tab with a page for each selection; none without one."""
    pages = [rrb.Grid(*_views(one), grid_columns=3, name=one.name) for one in chosen]
    return [rrb.Tabs(*pages, name="Selection")] if pages else []


def titles(one: Chosen) -> dict[str, str]:
    """What each picture shows, in words."""
    best = "proven optimum" if one.proven else "best found"
    words = ", ".join(one.taken) or "nothing"
    return {
        CORRELATION: f"Correlation of the candidates, {one.output} last · bright: selected",
        LANDSCAPE: f"Regressors of the best {len(one.genes)} genes, best first · {best}: {words}",
        COURSE: f"Search: least {one.criterion} so far",
        RESIDUAL: "What a model of the best gene leaves · grey: normal",
        SPECTRUM: "Its power spectrum · grey: white",
    }


def frequencies(one: Chosen) -> Array:
    """Of the spectrum, per sample."""
    return np.linspace(0.0, 0.5, len(one.spectrum) + 1)[1:]


def normal(x: Array) -> Array:
    """The standard normal density."""
    return np.asarray(np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi))


def _path(one: Chosen, picture: str) -> str:
    return entity(SELECTION, one.name, picture)


def _views(one: Chosen) -> list[rrb.View]:
    size = FIELD * (len(one.candidates) + 1)
    plane, wide = ((-12.0, FRAMED[0][1]), FRAMED[1]), (-1.2 * FIELD, size + 2.0 * _beside(one))
    bounds = {CORRELATION: (wide, wide)}
    shown = titles(one).items()
    return [plane_view(_path(one, picture), title, bounds.get(picture, plane)) for picture, title in shown]


def _log_correlation(rec: rr.RecordingStream, path: str, one: Chosen) -> None:
    """Fields from blue (-1) to vermillion (1)."""
    values = np.clip(np.array(one.correlation), -1.0, 1.0)[..., None]
    ground = np.array(GROUND)
    colour = ground + np.abs(values) * (np.where(values > 0, np.array(VERMILLION), np.array(BLUE)) - ground)
    fields = np.repeat(np.repeat(colour, FIELD, axis=0), FIELD, axis=1).round().astype(np.uint8)
    fields[:, ::FIELD], fields[::FIELD] = 16, 16
    rec.log(f"{path}/fields", rr.Image(fields), static=True)
    names = (*one.candidates, one.output)
    crowded = len(names) > NAMED  # then the selected ones alone are named
    for colour_of, mine in ((WHITE, True), (GREY, False))[: 1 if crowded else 2]:
        rows = [i for i, n in enumerate(names) if (n in one.taken or i == len(names) - 1) == mine]
        if rows:
            at = [[len(names) * FIELD + _beside(one), (i + 0.5) * FIELD - 1.5] for i in rows]
            text(rec, f"{path}/names/{mine}", at, [names[i] for i in rows], colour_of)


def _beside(one: Chosen) -> float:
    """How far from the fields their names have their middle: as far as names are wide, whatever the scale."""
    return FIELD * max(1.5, 0.14 * len(one.candidates))


def _log_course(rec: rr.RecordingStream, path: str, one: Chosen) -> None:
    """In steps."""
    course = np.array(one.history)
    corners = np.repeat(np.stack([np.arange(course.size), course], axis=1), 2, axis=0)
    steps = np.stack([corners[1:, 0], corners[:-1, 1]], axis=1)
    _log_line(rec, path, steps, "genes, generations or starts", one.criterion)


def _log_genes(rec: rr.RecordingStream, path: str, one: Chosen) -> None:
    """The best genes' scores as a line, and below it which candidates each has."""
    scores = np.array(one.scores)
    points = np.stack([np.arange(1.0, scores.size + 1), scores], axis=1)
    axes = Axes.around(points)
    frame(rec, path, axes, "rank", one.criterion)
    placed = axes.place(points)
    rec.log(
        f"{path}/line",
        rr.LineStrips2D([placed], colors=SKY_BLUE, radii=rr.Radius.ui_points(1.2)),
        static=True,
    )
    words = [", ".join(one.candidates[i] for i in gene) or "nothing" for gene in one.genes]
    dots = rr.Points2D(
        placed, colors=[ORANGE] + [SKY_BLUE] * (len(words) - 1), radii=rr.Radius.ui_points(3.0), labels=words,
        show_labels=False,
    )  # fmt: skip
    rec.log(f"{path}/genes", dots, static=True)


def _log_line(
    rec: rr.RecordingStream, path: str, points: Array, across: str, up: str, beside: Array | None = None
) -> None:
    """A line in its frame, and a grey one ``beside`` it at the same places."""
    other = np.empty((0, 2)) if beside is None else np.stack([points[:, 0], beside], axis=1)
    axes = Axes.around(np.concatenate([points, other]))
    frame(rec, path, axes, across, up)
    if other.size:
        line = rr.LineStrips2D([axes.place(other)], colors=GREY, radii=rr.Radius.ui_points(1.0))
        rec.log(f"{path}/beside", line, static=True)
    line = rr.LineStrips2D([axes.place(points)], colors=SKY_BLUE, radii=rr.Radius.ui_points(1.4))
    rec.log(f"{path}/line", line, static=True)
