from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import rerun as rr

from stages.results import Diagnosis
from viz.operating_map import lattice, node_sizes, som_bounds
from viz.plane import HEIGHT, WIDTH, Axes
from viz.send import segments


def grid(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=1)
    return np.concatenate([across, np.stack([index[:-1].ravel(), index[1:].ravel()], axis=1)])


def cross(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """Whether the segments a b and c d cross."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


@pytest.mark.parametrize(("rows", "columns"), [(2, 4), (5, 7), (6, 6), (1, 5)])
def test_a_lattice_unfolds_without_crossings(rows: int, columns: int) -> None:
    edges = grid(rows, columns)
    at = lattice(edges, rows * columns)
    crossing = [
        (e, f) for e, f in combinations(edges.tolist(), 2) if not set(e) & set(f) and cross(*at[e], *at[f])
    ]
    assert not crossing
    distance = np.linalg.norm(at[:, None] - at[None], axis=2) + 1e9 * np.eye(len(at))
    assert distance.min() > 0.3
    assert (lattice(edges, rows * columns) == at).all()


def test_a_chain_keeps_its_distances() -> None:
    at = lattice(grid(1, 6), 6)
    steps = np.linalg.norm(np.diff(at, axis=0), axis=1)
    assert steps == pytest.approx(np.ones(5))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_regions_without_neighbours_have_places_too(count: int) -> None:
    at = lattice(np.zeros((0, 2), dtype=np.int64), count)
    assert at.shape == (count, 2)
    assert np.isfinite(at).all()
    assert len(np.unique(at.round(6), axis=0)) == count


def test_axes_hold_all_points_and_count_downwards() -> None:
    points = np.array([[800.0, 101.0], [4100.0, 214.0], [np.nan, 150.0]])
    axes = Axes.around(points)
    placed = axes.place(points[:2])
    assert (placed >= [0.0, -HEIGHT]).all()
    assert (placed <= [WIDTH, 0.0]).all()
    assert placed[1, 1] < placed[0, 1]
    corner = axes.place(np.array([[axes.x[1], axes.y[1]]]))
    assert corner == pytest.approx(np.array([[WIDTH, -HEIGHT]]))


def test_axes_of_nothing() -> None:
    axes = Axes.around(np.full((3, 2), np.nan))
    assert axes.x[1] > axes.x[0]


def test_areas_go_with_the_visits() -> None:
    sizes = node_sizes(np.array([0.0, 25.0, 100.0, np.nan]), 0.0, 10.0)
    assert sizes == pytest.approx([0.0, 5.0, 10.0, 0.0])


def test_segments_are_what_rerun_makes_of_strips() -> None:
    points = np.random.default_rng(1).random((7, 2))
    strips = list(np.stack([points[:-1], points[1:]], axis=1))
    expected = rr.components.LineStrip2DBatch(strips).as_arrow_array()
    assert segments(points).equals(expected)
    assert len(segments(points[:1])) == 0


def test_the_graph_is_seen_whole(diagnosis: Diagnosis) -> None:
    plane = diagnosis.operating_map
    assert plane is not None
    (left, right), (top, bottom) = som_bounds(plane)
    at = 10.0 * lattice(plane.edges, len(plane.nodes))
    assert left < at[:, 0].min() - 4.0
    assert at[:, 0].max() + 4.0 < right
    assert top < at[:, 1].min() - 4.0
    assert at[:, 1].max() + 4.0 < bottom
