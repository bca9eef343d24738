"""Where the system was: samples by regime, regions, a point and trail that follow the cursor, the SOM."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from stages.results import Diagnosis, OperatingMap
from viz import send
from viz.colours import DIM, GREY, WHITE, of_index, ramp
from viz.lanes import regime_name
from viz.plane import FRAMED, Axes, Range, frame, text
from viz.series import Array

SAMPLES = 6000
"""Samples drawn on the map, evenly taken."""
CURSOR_HZ = 5.0
TRAIL_S = 20.0
MAP, SOM = "/map", "/som"


def log_operating_map(rec: rr.RecordingStream, diagnosis: Diagnosis, plane: OperatingMap) -> None:
    """The map below ``/map`` and the self-organising map below ``/som``."""
    data = np.stack([plane.x, plane.y], axis=1)
    axes = Axes.around(np.concatenate([data, plane.nodes]))
    regime = diagnosis.samples["regime"].fill_null(-1).to_numpy()
    frame(rec, MAP, axes, plane.x_label, plane.y_label)
    _log_samples(rec, axes.place(data), regime)
    log_regions(rec, axes.place(plane.nodes), plane)
    log_cursor(rec, diagnosis.samples["time"].to_numpy(), axes.place(data))
    _log_som(rec, plane)


def _log_samples(rec: rr.RecordingStream, placed: Array, regime: NDArray[np.int64]) -> None:
    finite = np.flatnonzero(np.isfinite(placed).all(axis=1))
    rows = finite[:: max(1, -(-finite.size // SAMPLES))]
    colours = [of_index(r) if r >= 0 else DIM for r in regime[rows].tolist()]
    dots = rr.Points2D(placed[rows], colors=colours, radii=rr.Radius.ui_points(1.1))
    rec.log(f"{MAP}/samples", dots, static=True)


def log_regions(rec: rr.RecordingStream, nodes: Array, plane: OperatingMap) -> None:
    """Region centres, their size the visits, joined as on the self-organising map."""
    colours = np.array([of_index(i) for i in range(len(nodes))], dtype=np.uint8).reshape(-1, 3)
    _log_nodes(rec, f"{MAP}/regions", nodes, plane, colours, most=10.0)
    text(
        rec, f"{MAP}/names", nodes + np.array([0.0, 3.2]), [regime_name(i) for i in range(len(nodes))], WHITE
    )


def _log_nodes(
    rec: rr.RecordingStream,
    path: str,
    at: Array,
    plane: OperatingMap,
    colours: NDArray[np.uint8],
    *,
    most: float,
) -> None:
    """Discs with a rim, and the lattice's edges under them."""
    edges = rr.LineStrips2D(list(at[plane.edges]), colors=GREY, radii=rr.Radius.ui_points(0.7))
    rec.log(f"{path}/edges", edges, static=True)
    sizes = node_sizes(plane.visits, 0.4 * most, most)
    for name, colour, grow, order in (("rim", WHITE, 1.5, 31.0), ("nodes", colours, 0.0, 32.0)):
        radii = rr.Radius.ui_points(sizes + grow)
        rec.log(f"{path}/{name}", rr.Points2D(at, colors=colour, radii=radii, draw_order=order), static=True)


def node_sizes(visits: Array, least: float, most: float) -> Array:
    """Radii whose areas above the least go with the visits."""
    top = float(np.nanmax(visits)) if visits.size else 0.0
    return least + (most - least) * np.sqrt(np.nan_to_num(visits) / (top or 1.0))


def log_cursor(rec: rr.RecordingStream, time: Array, placed: Array) -> None:
    """One point and the line to it per ``1 / CURSOR_HZ``; how long the trail is, the layout decides."""
    beat = np.floor(time * CURSOR_HZ)
    rows = np.flatnonzero(np.append(True, np.diff(beat) != 0) & np.isfinite(placed).all(axis=1))
    at = placed[rows]
    rec.log(f"{MAP}/now", rr.Points2D.from_fields(colors=WHITE, radii=rr.Radius.ui_points(6.0)), static=True)
    rec.log(
        f"{MAP}/trail", rr.LineStrips2D.from_fields(colors=WHITE, radii=rr.Radius.ui_points(1.2)), static=True
    )
    if rows.size > 1:
        rec.send_columns(f"{MAP}/now", send.times(time[rows]), rr.Points2D.columns(positions=at))
        columns = rr.LineStrips2D.columns(strips=send.segments(at))
        rec.send_columns(f"{MAP}/trail", send.times(time[rows[1:]]), columns)


def lattice(edges: NDArray[np.int64], count: int) -> Array:
    """Places (count, 2) of a graph's nodes by classical multidimensional scaling of their hop distances.

    With D the distances and J = I - 11'/n: the two leading eigenvectors of -J D² J / 2, each times the root
    of its eigenvalue (W. S. Torgerson, Psychometrika 17, 1952). A square lattice comes out as one.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import shortest_path

    ones = np.ones(len(edges))
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))
    hops = shortest_path(graph.tocsr(), directed=False, unweighted=True)
    far = hops[np.isfinite(hops)].max(initial=0.0) + 2.0
    squared = np.where(np.isfinite(hops), hops, far) ** 2
    centred = squared - squared.mean(axis=0) - squared.mean(axis=1)[:, None] + squared.mean()
    values, vectors = np.linalg.eigh(-centred / 2.0)
    lead = vectors[:, ::-1][:, :2] * np.sqrt(np.clip(values[::-1][:2], 0.0, None))
    lead = np.pad(lead, ((0, 0), (0, 2 - lead.shape[1])))
    signs = np.where(lead[np.abs(lead).argmax(axis=0), [0, 1]] < 0, -1.0, 1.0)
    return np.asarray(lead * signs, dtype=np.float64)


def _log_som(rec: rr.RecordingStream, plane: OperatingMap) -> None:
    """The map as a graph: size visits, colour the spread of the training residuals."""
    if not len(plane.nodes):
        return
    at = _places(plane)
    _log_nodes(rec, f"{SOM}/regions", at, plane, ramp(plane.spread), most=22.0)
    known = [f"{regime_name(i)}: {visits:.0f}" for i, visits in enumerate(plane.visits)]
    text(rec, f"{SOM}/names", at + np.array([0.0, 2.2]), known, WHITE)


def _places(plane: OperatingMap) -> Array:
    """Where the nodes of the graph stand, (nodes, 2)."""
    return 10.0 * lattice(plane.edges, len(plane.nodes))


def som_bounds(plane: OperatingMap) -> tuple[Range, Range]:
    """What the graph needs to be seen whole, with its discs and names: limits across and downwards."""
    if not len(plane.nodes):
        return FRAMED
    at = _places(plane)
    low, high = at.min(axis=0), at.max(axis=0)
    margin = 0.16 * max(*(high - low), 10.0)
    across, down = ((float(a - margin), float(b + margin)) for a, b in zip(low, high, strict=True))
    return across, down
