from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from stages.partition import Growth, Partition, grow


def square(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    S = np.random.default_rng(seed).uniform(size=(n, 2))
    return S, np.sin(6 * S[:, 0]) * S[:, 1]


def test_assign_is_the_nearest_node() -> None:
    S, y = square(2000)
    partition = grow(S, y, np.ones(2000), Growth(nodes=9))
    np.testing.assert_array_equal(partition.assign(S), cdist(S, partition.nodes).argmin(axis=1))
    assert partition.assign(np.array([[np.nan, 0.5]])).tolist() == [-1]


def test_distances_are_shortest_paths() -> None:
    chain = Partition(np.arange(4.0)[:, None], np.array([[0, 1], [1, 2], [2, 3]]))
    np.testing.assert_array_equal(chain.distances()[0], [0, 1, 2, 3])


@settings(max_examples=25, deadline=None)
@given(st.integers(20, 400), st.integers(1, 20), st.integers(0, 5))
def test_stopping_rules_hold(n: int, nodes: int, seed: int) -> None:
    """S2 and S3, for any sample; the map is connected."""
    S, y = square(n, seed)
    partition = grow(S, y, np.ones(n), Growth(nodes=nodes, samples_per_parameter=4, epochs=0))
    count = np.bincount(partition.assign(S), minlength=len(partition.nodes))
    assert len(partition.nodes) <= nodes
    assert np.isfinite(partition.distances()).all()
    if len(partition.nodes) > 1:  # cells of split halves: a few samples may change sides
        assert count.sum() == n
        assert count.min() >= 0.5 * 4 * 3


def test_stops_at_the_wanted_error() -> None:
    S = np.random.default_rng(0).uniform(size=(500, 2))
    plane = 1 + S @ np.array([2.0, -3.0])
    assert len(grow(S, plane, np.ones(500), Growth(nodes=16, max_error=1e-6)).nodes) == 1


def test_a_constant_direction_does_not_stop_the_map() -> None:
    """S4 as printed never acts; ours refuses a split whose Gram matrix is singular, and goes on elsewhere."""
    rng = np.random.default_rng(1)
    S = np.column_stack([rng.uniform(size=600), np.full(600, 0.5)])
    partition = grow(S, np.sin(9 * S[:, 0]), np.ones(600), Growth(nodes=8))
    assert np.isfinite(partition.nodes).all()


def test_nodes_go_where_the_error_is() -> None:
    rng = np.random.default_rng(2)
    S = rng.uniform(size=(4000, 1))
    y = np.where(S[:, 0] < 0.5, S[:, 0], np.sin(40 * S[:, 0]))
    nodes = grow(S, y, np.ones(4000), Growth(nodes=12)).nodes[:, 0]
    assert (nodes > 0.5).sum() >= 9


def test_deterministic() -> None:
    S, y = square(1500)
    one, two = (grow(S, y, np.ones(1500), Growth(nodes=10)) for _ in range(2))
    np.testing.assert_array_equal(one.nodes, two.nodes)
    np.testing.assert_array_equal(one.edges, two.edges)
