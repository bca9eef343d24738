from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.hypotheses import DRIFT_PRIOR, Drift, Hypothesis, Points
from stages.normalise import Normalise
from stages.regressors import Regressors
from stages.relation import Relation
from stages.relations import Relations
from stages.residuals import Residuals
from stages.stage import ANALYSIS, RowWise, transform


def system(n: int = 800) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    a = rng.uniform(1, 2, n)
    return {"time": np.arange(n) / 2, "a": a, "y": 2 * a + 1 + rng.normal(0, 0.01, n)}


@pytest.fixture(scope="module")
def chain() -> list[RowWise]:
    block = Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame(system()))})
    out: list[RowWise] = []
    for stage in (
        Regressors(columns={"half": "y / 2"}),
        Normalise(columns=("a",)),
        Relations(
            relations={"f": Relation(output="half", inputs=("a",), nodes=3)}, regime="f", map=("a", "y")
        ),
        Residuals(residuals={"r": "half - f"}),
    ):
        ready = stage.fit([block]) if hasattr(stage, "fit") else stage
        out.append(ready)
        block = transform([ready], block)
    return out


def test_undoing_the_right_size_brings_the_residual_back(chain: list[RowWise]) -> None:
    values = system()
    values["y"] = values["y"] * 1.1
    gain = Hypothesis(undo={"y": "y / (1 + theta)"}, sizes=(0.05, 0.1, 0.2))
    points = Points([gain], chain, ["r"])
    assert points.needs == {"a", "y", "time"} - {"time"}
    e, sigma, doubt, novelty = points.evaluate(values, np.zeros(800))
    assert e.shape == sigma.shape == doubt.shape == (800, 1, 4)
    error = np.abs(e[:, 0]).mean(axis=0)
    assert error.argmin() == 2
    assert error[2] < 0.01 < error[1]
    assert (novelty <= 1).mean() > 0.98


def test_what_is_not_computed_anew_would_be_the_same(chain: list[RowWise]) -> None:
    """Every point against the whole chain on the corrected columns."""
    values = system(50)
    hypotheses = [
        Hypothesis(undo={"y": "y / (1 + theta)"}, sizes=(0.1, 0.2)),
        Hypothesis(undo={"a": "a - theta", "y": "y + a * theta"}, sizes=(-0.1, 0.1)),
        Hypothesis(undo={"half": "half - theta"}, sizes=(0.3,)),
    ]
    e, sigma, doubt, _ = Points(hypotheses, chain, ["r"]).evaluate(values, np.zeros(50))
    point = 1
    for h in hypotheses:
        for theta in h.sizes:
            scope = {**values, "half": values["y"] / 2, "theta": np.full(50, theta)}
            corrected = {**scope, **{c: f(scope) for c, f in h.formulas.items()}}
            for stage in chain:
                if not (isinstance(stage, Regressors) and "half" in h.undo):
                    corrected |= stage.compute(corrected)
            for kind, found in (("residual.", e), ("sigma.", sigma), ("model_sd.", doubt)):
                np.testing.assert_allclose(found[:, 0, point], corrected[kind + "r"], atol=1e-12)
            point += 1


def test_points_undone_together_are_those_undone_alone(chain: list[RowWise]) -> None:
    values = system(50)
    hypotheses = [
        Hypothesis(undo={"y": "y / (1 + theta)"}, sizes=(0.1, 0.2)),
        Hypothesis(undo={"a": "a - theta", "y": "y + a * theta"}, sizes=(-0.1, 0.1)),
        Hypothesis(undo={"half": "half - theta"}, sizes=(0.3,)),
        Hypothesis(undo={"a": "a - theta * exp(-elapsed / 30)"}, sizes=(0.1, 0.2)),
    ]
    points = Points(hypotheses, chain, ["r"])
    base = points.as_it_is(values, values["time"])
    which = np.array([[0, 1], [2, 3], [1, 0], [0, 3], [2, 3], [3, 3]])
    sizes = np.array([[0.1, 0.05], [0.3, 0.1], [0.05, 0.1], [0.2, -0.1], [0.1, 0.2], [0.1, 0.1]])
    together = points.undone(base, which, sizes)
    for k in range(len(which)):
        alone = points.undone(base, which[k : k + 1], sizes[k : k + 1])
        for column in ("residual.r", "sigma.r", "model_sd.r", "novelty.r"):
            np.testing.assert_allclose(together[column][k], alone[column][0], rtol=1e-12)


def test_chunks_do_not_matter_and_nothing_is_changed(
    chain: list[RowWise], monkeypatch: pytest.MonkeyPatch
) -> None:
    values = system()
    copy = {k: v.copy() for k, v in values.items()}
    drift = Drift(undo={"y": "y / (1 + theta * exp(-elapsed / 30))"}, sd=0.03).hypothesis()
    points = Points([drift], chain, ["r"])
    whole = points.evaluate(values, values["time"])
    monkeypatch.setattr("stages.hypotheses.CHUNK", 37)
    for one, two in zip(whole, points.evaluate(values, values["time"]), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-12)
    assert all((values[k] == copy[k]).all() for k in copy)


def test_a_drift_fades_with_time(chain: list[RowWise]) -> None:
    drift = Drift(undo={"y": "y / (1 + theta * exp(-elapsed / 30))"}, sd=0.03).hypothesis()
    e = Points([drift], chain, ["r"]).evaluate(system(), system()["time"])[0][:, 0]
    apart = np.abs(e[:, 1] - e[:, 0])
    assert apart[:20].mean() > 0.05
    assert apart[-20:].mean() < 1e-4
    assert 0 < 1 - sum(DRIFT_PRIOR) < 1


def test_mistakes() -> None:
    good = Hypothesis(undo={"y": "y - theta"}, sizes=(1.0, 2.0))
    for sizes in ((), (2.0, 1.0), (0.0, 1.0)):
        with pytest.raises(RecipeError, match="rising `sizes` without 0"):
            replace(good, sizes=sizes)
    with pytest.raises(RecipeError, match="needs `undo`"):
        replace(good, undo={})
    with pytest.raises(RecipeError, match="unknown function"):
        replace(good, undo={"y": "leek_flow(theta)"})
