from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

from ingest.log import Group, Log
from stages.bending import bend_of
from stages.gsmms import Combination, fit_gsmms
from stages.partition import Growth
from stages.relation import Relation
from stages.relations import Relations
from stages.stage import ANALYSIS, columns, transform

Array = NDArray[np.float64]


def curve(x: Array, bow: float) -> Array:
    noise = np.random.default_rng(5).normal(0, 0.001, len(x))
    return x + bow * np.sin(4 * x) + noise


def bend(bow: float, combination: Combination = "blended", nodes: int = 4) -> float:
    x = np.random.default_rng(3).uniform(0, 1, 2000)
    model = fit_gsmms(x[:, None], curve(x, bow), growth=Growth(nodes=nodes), combination=combination)
    return bend_of(model, x[:, None], curve(x, bow), np.ones(len(x)))


@pytest.mark.parametrize("combination", ["blended", "hard"])
def test_it_goes_with_the_curvature(combination: Combination) -> None:
    assert bend(0.0, combination) == pytest.approx(0.0, abs=1e-4)
    assert bend(1.0, combination) > 0.01
    assert bend(2.0, combination) == pytest.approx(2 * bend(1.0, combination), rel=0.05)


def test_what_cannot_be_left_out_says_nothing() -> None:
    assert bend(1.0, nodes=1) == 0.0


def test_a_missing_or_weightless_row_does_not_count() -> None:
    x = np.random.default_rng(4).uniform(0, 1, 600)
    S, y, weight = x[:, None], curve(x, 1.0), np.ones(600)
    model = fit_gsmms(S, y, growth=Growth(nodes=4))
    more = np.vstack([S, [[np.nan], [0.5]]])
    longer, weights = np.append(y, [1.0, 1e6]), np.append(weight, [1.0, 0.0])
    assert bend_of(model, more, longer, weights) == bend_of(model, S, y, weight) > 0


def test_beyond_the_trained_domain_the_doubt_is_of_the_size_of_the_error() -> None:
    """Many samples tell where the curve is, not where it goes: without the bend the error is 12 times the
    doubt."""

    def log(x: Array) -> Log:
        y = curve(x, 2.0)
        frame = pl.DataFrame({"time": np.arange(len(x)) * 1.0, "x": x, "x.norm": x, "y": y})
        return Log("x", {ANALYSIS: Group(ANALYSIS, frame)})

    relations = {"f": Relation(output="y", inputs=("x",), nodes=4)}
    stage = Relations(relations=relations, regime="f", map=("x", "y"))
    stage = stage.fit([log(np.random.default_rng(3).uniform(0, 1, 2000))])
    beyond, inside = (
        columns(transform([stage], log(np.linspace(a, b, 50)))) for a, b in ((1.05, 1.1), (0.1, 0.9))
    )
    error = np.abs(beyond["y"] - beyond["f"])
    assert (error < 4 * beyond["f.sd"]).all()
    assert (error > beyond["f.sd"] / 4).all()
    assert np.median(inside["f.sd"]) < 0.2 * np.median(beyond["f.sd"])
