from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import LogError
from stages.relation import Relation
from stages.topology import study

Array = NDArray[np.float64]
N = 1200


def data(seed: int, f: Callable[[Array], Array], noise: float = 0.05) -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(seed)
    S = rng.uniform(size=(N, 2))
    return S, f(S) + noise * rng.normal(size=N), np.ones(N), np.ones(N)


def test_a_plane_needs_one_region() -> None:
    """In most of five sets: what is more is chosen only where it looks better by chance."""
    chosen = [
        study(*data(s, lambda S: 1 + S[:, 0] - 2 * S[:, 1]), (1, 4, 8), 6.0).chosen.nodes for s in range(10)
    ]
    assert sum(n == 1 for n in chosen) >= 8


def test_a_curved_surface_needs_several() -> None:
    found = study(*data(1, lambda S: np.sin(7 * S[:, 0]) * S[:, 1]), (1, 4, 12, 24), 6.0)
    assert found.chosen.nodes >= 12
    of_one = next(c for c in found.candidates if c.nodes == 1)
    assert found.chosen.rms < 0.5 * of_one.rms
    assert found.chosen.rms == pytest.approx(0.05, rel=0.6)
    assert min(c.rms for c in found.candidates) + 1e-9 >= found.chosen.rms - found.chosen.se * 2


def test_every_size_is_tried_blended_and_hard() -> None:
    found = study(*data(2, lambda S: S[:, 0] ** 2), (1, 4), 6.0)
    assert [(c.nodes, c.combination, c.neighbourhood) for c in found.candidates] == [
        (1, "blended", 0.4), (4, "blended", 0.4), (4, "hard", 0.4), (4, "hard", 0.8),
    ]  # fmt: skip
    rows = found.to_arrays()["study"]
    assert rows.shape == (4, 6)
    assert rows[:, -1].sum() == 1


def test_too_few_rows() -> None:
    S, y, weight, own = (x[:8] for x in data(3, lambda S: S[:, 0]))
    with pytest.raises(LogError, match="too few"):
        study(S, y, weight, own, (1, 4), 6.0)


def test_a_relation_takes_what_was_chosen_and_keeps_it() -> None:
    S, y, weight, _ = data(4, lambda S: np.sin(7 * S[:, 0]) * S[:, 1])
    values = {
        "time": np.arange(float(N)),
        "a": S[:, 0],
        "b": S[:, 1],
        "a.norm": S[:, 0],
        "b.norm": S[:, 1],
        "y": y,
    }
    relation = Relation(output="y", inputs=("a", "b"), nodes=2, sizes=(1, 12))
    found = relation.study(values, ("a", "b"), weight)
    assert found is not None
    settled = relation.settled(found)
    assert settled.nodes == 12
    model = settled.fit(values, ("a", "b"), weight, None)
    assert model is not None
    assert len(model.theta) == 12
    assert replace(relation, sizes=()).study(values, ("a", "b"), weight) is None
    assert relation.settled(None) == relation
