from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError, RecipeError
from ingest.log import Group, Log
from stages.continuing import continued, gather
from stages.relation import Relation
from stages.relations import Relations
from stages.stage import ANALYSIS


def block(seed: int, rows: int = 900, valve: float = 0.0) -> Log:
    """Two relations, the second made from the first; regressors between 0 and 1."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(size=(2, rows))
    y = 3.0 + np.sin(4 * a) + b**2 + 0.01 * rng.normal(size=rows)
    z = y * (1 + a * b) + 0.01 * rng.normal(size=rows)
    frame = pl.DataFrame(
        {"time": np.arange(rows) * 0.5, "a": a, "b": b, "a.norm": a, "b.norm": b, "y": y, "z": z,
         "gate": rng.uniform(size=rows), "valve": np.full(rows, valve)}
    )  # fmt: skip
    return Log(f"log{seed}", {ANALYSIS: Group(ANALYSIS, frame)})


STAGE = Relations(
    relations={
        "f": Relation(output="y", inputs=("a", "b"), nodes=6),
        "g": Relation(output="z / f", inputs=("a", "b"), nodes=5, weight="1 + a"),
        "v": Relation(output="y", inputs=("a",), where="valve - 1"),
    },
    regime="f",
    map=("a", "b"),
)
LOGS = [block(seed, rows) for seed, rows in ((1, 900), (2, 400), (3, 1500), (4, 70))]


@pytest.fixture(scope="module")
def fitted() -> Relations:
    return STAGE.fit(LOGS[:2])


def test_continued_is_the_fit_on_all_logs_at_once(fitted: Relations) -> None:
    first = gather(fitted, LOGS[:2])
    step = gather(fitted, LOGS[3:], gather(fitted, LOGS[2:3], first))
    at_once = continued(fitted, gather(fitted, LOGS))
    in_steps = continued(fitted, step)
    for name, array in at_once.learned.items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(in_steps.learned[name], array, rtol=1e-8, atol=1e-10, err_msg=name)


def test_the_order_of_the_steps_does_not_count_for_what_is_learned_next(fitted: Relations) -> None:
    """What has been solved in between leaves no trace in the sums."""
    first = gather(fitted, LOGS[:2])
    between = continued(fitted, gather(fitted, LOGS[2:3], first))
    one = continued(between, gather(between, LOGS[3:], gather(fitted, LOGS[2:3], first)))
    two = continued(fitted, gather(fitted, LOGS))
    np.testing.assert_allclose(one.learned["g/theta"], two.learned["g/theta"], rtol=1e-8, atol=1e-10)


def test_the_sums_of_the_first_logs_give_the_fit_again(fitted: Relations) -> None:
    again = continued(fitted, gather(fitted, LOGS[:2]))
    for name in ("f/theta", "g/theta", "f/mean", "f/whiten", "map/visits", "map/nodes", "map/spread"):
        np.testing.assert_allclose(again.learned[name], fitted.learned[name], rtol=1e-6, atol=1e-8)
    one, two = (np.linalg.norm(r.learned["f/root"]) for r in (again, fitted))
    assert one == pytest.approx(two, rel=0.35)  # other blocks, the same doubt


def test_more_logs_make_the_relations_better_and_surer(fitted: Relations) -> None:
    more = continued(fitted, gather(fitted, [*LOGS, *(block(s) for s in range(10, 20))]))
    truth = block(99, 4000)
    values = {n: truth.values(n) for n in ("a.norm", "b.norm", "y")}
    S = np.column_stack([values["a.norm"], values["b.norm"]])
    error = [np.sqrt(np.mean((r.models["f"].predict(S) - values["y"]) ** 2)) for r in (fitted, more)]
    assert error[1] < error[0]
    assert np.linalg.norm(more.learned["f/root"]) < np.linalg.norm(fitted.learned["f/root"])


def test_the_sums_stay_small(fitted: Relations) -> None:
    sums = gather(fitted, [block(s, 5000) for s in range(6)])
    assert 20 <= len(sums["f/rows"]) <= 40
    assert sums["f/rows"].sum() == pytest.approx(30_000)
    assert len({*sums["f/rows"][:-1]}) == 1


def test_what_has_never_been_fitted_cannot_be_continued(fitted: Relations) -> None:
    assert "v/theta" not in fitted.learned
    with pytest.raises(LogError, match="'log5': relation 'v' holds in it and was never fitted"):
        gather(fitted, [block(5, valve=2.0)])
    hard = replace(STAGE, relations={"f": replace(STAGE.relations["f"], combination="hard")}).fit(LOGS[:1])
    with pytest.raises(RecipeError, match="only blended"):
        gather(hard, LOGS[:1])
