from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError, RecipeError
from ingest.log import Group, Log
from ingest.simulators.examples import STRUCTURES, simulate_example
from stages.narx import COMBINATIONS, Narx
from stages.relation import Relation
from stages.relations import Relations
from stages.select_inputs import SelectInputs, Target
from stages.stage import ANALYSIS, columns, cut, run_stages, transform

TARGET = Target(output="y", outputs=("y",), inputs=("u1", "u2", "u3"), na_max=3, nb_max=3, nk_max=7)
TRUE = ("y(t-1)", "u1(t-6)", "u2(t-4)")


def block(seed: int = 601, n: int = 1500, gap: int | None = None) -> Log:
    """Example 2 on the analysis raster; a day is missing after row ``gap``."""
    log = simulate_example("example2", n=n, seed=seed)
    frame = log.groups["example2"].frame
    if gap is not None:
        late = (pl.int_range(pl.len()) >= gap).cast(pl.Float64) * 86400
        frame = frame.with_columns(pl.col("time") + late)
    return replace(log, groups={ANALYSIS: Group(ANALYSIS, frame)})


@pytest.fixture(scope="module")
def fitted() -> SelectInputs:
    return SelectInputs(targets={"f_y": TARGET}).fit([block()])


def test_the_chosen_regressors_are_the_true_ones_and_their_columns_are_lags(fitted: SelectInputs) -> None:
    assert fitted.chosen("f_y") == TRUE
    assert fitted.adds == {n + ".norm" for n in TRUE}
    log = block(602, 100)
    out, u1 = columns(transform([fitted], log)), log.values("u1")
    x = out["u1(t-6).norm"]
    assert np.isnan(x[:6]).all()
    assert np.corrcoef(x[6:], u1[:-6])[0, 1] == pytest.approx(1.0)
    assert x[6:].std() == pytest.approx(1.0, rel=0.2)


def test_what_it_was_decided_on_is_kept(fitted: SelectInputs) -> None:
    one = fitted.portrait("f_y")
    assert (one.name, one.output, one.taken) == ("f_y", "y", TRUE)


def test_a_window_never_spans_a_gap_and_blocks_change_nothing(fitted: SelectInputs) -> None:
    log = block(602, 200, gap=90)
    whole = columns(transform([fitted], log))
    x = whole["u1(t-6).norm"]
    assert np.flatnonzero(np.isnan(x)).tolist() == [*range(6), *range(90, 96)]
    first, second = (log.between(a, b) for a, b in ((0, 100), (86400, 86600)))
    for parts in ([first, second], list(cut(first, 3.0)) + list(cut(second, 17.0))):
        blocks = [b.groups[ANALYSIS].frame["u1(t-6).norm"] for b in run_stages([fitted], parts)]
        np.testing.assert_array_equal(pl.concat(blocks).to_numpy(), x)


def test_training_logs_are_not_joined(fitted: SelectInputs) -> None:
    assert SelectInputs(targets={"f_y": TARGET}).fit([block(601, 800), block(603, 800)]).chosen("f_y") == TRUE


def test_a_model_takes_what_was_selected(fitted: SelectInputs) -> None:
    narx = Narx(models={"f_y": "y"}, regime="f_y", map=("u1", "y"))
    model = narx.fit([transform([fitted], block())], [[fitted]])
    assert model.inputs("f_y") == TRUE
    out = columns(transform([fitted, model], block(602, 2000)))
    error = (out["y"] - out["f_y"])[6:]
    assert error.std() < 1.04 * 0.05
    blended, hard = (model.learned["f_y/held_out"][COMBINATIONS.index(c)] for c in ("blended", "hard"))
    assert blended < hard
    refitted = model.refit([transform([fitted], block(604))])
    assert refitted.inputs("f_y") == TRUE
    np.testing.assert_array_equal(refitted.learned["f_y/metric"], model.learned["f_y/metric"])
    assert not np.array_equal(refitted.learned["f_y/theta"], model.learned["f_y/theta"])


def test_columns_as_they_are() -> None:
    """Among present values; a candidate that says nothing is left out, a fixed one stays."""
    rng = np.random.default_rng(0)
    a, b, c = rng.uniform(0, 1, size=(3, 3000))
    y = a * b + 0.01 * rng.normal(size=3000)
    frame = pl.DataFrame({"time": np.arange(3000.0), "y": y, "a": a, "b": b, "c": c})
    log = Log("x", {ANALYSIS: Group(ANALYSIS, frame)})
    target = Target(output="y", inputs=("a", "b", "c"))
    stage = SelectInputs(targets={"f": target})
    assert stage.fit([log]).chosen("f") == ("a", "b")
    assert stage.fit([log]).adds == set()
    fixed = SelectInputs(targets={"f": replace(target, fixed=("c",))})
    assert fixed.fit([log]).chosen("f") == ("a", "b", "c")
    assert stage.needs == {"y", "a", "b", "c", "a.norm", "b.norm", "c.norm"}


def test_nothing_to_select_is_said() -> None:
    rng = np.random.default_rng(0)
    frame = pl.DataFrame(
        {"time": np.arange(500.0), **{n: rng.normal(size=500) for n in ("y", "a", "a.norm")}}
    )
    log = Log("noise", {ANALYSIS: Group(ANALYSIS, frame)})
    stage = SelectInputs(targets={"f": Target(output="y", inputs=("a",))}).fit([log])
    assert stage.chosen("f") == ()
    with pytest.raises(LogError, match="has no inputs"):
        Narx(models={"f": "y"}, regime="f", map=("y", "a")).fit([log], [[stage]])


def test_a_fault_cannot_be_undone_in_lags(fitted: SelectInputs) -> None:
    with pytest.raises(RecipeError, match="use `detect`"):
        fitted.compute({})


def test_wrong_targets_are_refused() -> None:
    with pytest.raises(RecipeError, match="no candidate"):
        Target(output="y")
    with pytest.raises(RecipeError, match="is no candidate"):
        Target(output="y", inputs=("a",), fixed=("b",))


def test_the_truth_of_the_test_is_that_of_the_simulator() -> None:
    assert STRUCTURES["example2"]["y"]["nk"] == {"u1": 6, "u2": 4, "u3": 0}


def test_relations_take_what_was_selected_in_place_of_their_own() -> None:
    rng = np.random.default_rng(0)
    a, b, c = rng.uniform(0, 1, size=(3, 2000))
    y = a * b + 0.01 * rng.normal(size=2000)
    named = {"y": y, "a": a, "b": b, "c": c, "a.norm": a, "b.norm": b, "c.norm": c}
    log = Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame({"time": np.arange(2000.0), **named}))})
    stage = SelectInputs(targets={"f": Target(output="y", inputs=("a", "b", "c"))}).fit([log])
    relations = Relations(
        relations={name: Relation(output="y", inputs=("a", "c")) for name in "fg"},
        regime="f", map=("a", "b"),
    ).fit([log], [[stage]])  # fmt: skip
    assert (relations.inputs("f"), relations.inputs("g")) == (("a", "b"), ("a", "c"))
    assert relations.refit([log]).inputs("f") == ("a", "b")
    out = columns(transform([stage, relations], log))
    assert (out["y"] - out["f"]).std() < 0.012 < 0.05 < (out["y"] - out["g"]).std()
