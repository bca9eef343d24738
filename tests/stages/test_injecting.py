from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ingest.errors import RecipeError
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from pipeline import load_recipe
from pipeline.diagnosing import supposed
from pipeline.template import bound, common_signals
from stages.hypotheses import ELAPSED, THETA, Hypothesis
from stages.injecting import inject, injectable, readings
from stages.stage import columns, transform

FORMULAS = {
    "gain": Hypothesis(undo={"x": "x / (1 + theta)"}, sizes=(0.1,)),
    "offset": Hypothesis(undo={"x": "x - theta"}, sizes=(0.1,)),
    "curved": Hypothesis(undo={"x": "x * x / (100 + theta)"}, sizes=(0.1,)),
    "two": Hypothesis(undo={"x": "x / (1 + theta)", "leak": "leak + theta * x"}, sizes=(0.1,)),
}


@given(
    st.sampled_from(sorted(FORMULAS)),
    st.floats(-0.5, 3.0),
    st.lists(st.floats(1.0, 500.0), min_size=1, max_size=5),
)
def test_undoing_what_was_injected_gives_the_healthy_log(name: str, size: float, x: list[float]) -> None:
    values = {"time": np.arange(float(len(x))), "x": np.array(x), "leak": np.zeros(len(x))}
    hypothesis = FORMULAS[name]
    faulty = readings(values, hypothesis, size)
    scope = {**values, **faulty, THETA: np.full(len(x), size), ELAPSED: values["time"]}
    for column, formula in hypothesis.formulas.items():
        np.testing.assert_allclose(formula(scope), values[column], rtol=1e-6, atol=1e-6)


def test_missing_readings_stay_missing() -> None:
    values = {"time": np.arange(3.0), "x": np.array([1.0, np.nan, 2.0])}
    found = readings(values, FORMULAS["gain"], 0.1)["x"]
    np.testing.assert_allclose(found, [1.1, np.nan, 2.2])


def test_a_stuck_valve_cannot_be_injected() -> None:
    stuck = Hypothesis(undo={"x": "theta"}, sizes=(5.0,), from_zero=False)
    assert not injectable(stuck)
    with pytest.raises(RecipeError, match="forgets the reading"):
        readings({"time": np.zeros(1), "x": np.ones(1)}, stuck, 5.0)


def test_it_is_what_the_simulator_makes_of_a_sensor_that_is_not_in_a_loop() -> None:
    """Up to how fast the fault sets in: the raster's averages span the onset."""
    recipe = load_recipe("diesel_airpath")
    fault = Fault(name="maf_gain", magnitude=0.08, onset_s=100.0)
    healthy = simulate_airpath(cycle="udds", duration_s=300, seed=5)
    faulty = simulate_airpath(cycle="udds", duration_s=300, seed=5, faults=[fault])
    recipe = bound(recipe, common_signals([healthy]))
    place = next(i for i, use in enumerate(recipe.uses) if use == "gate") + 1
    prepared, truth = (transform(recipe.stages[:place], log) for log in (healthy, faulty))
    injected = inject(prepared, supposed(recipe)["maf_gain"], 0.08, 100.0)
    one, two = columns(injected), columns(truth)
    away = np.abs(one["time"] - 100.0) > 3.0
    np.testing.assert_allclose(one["W_HFM"][away], two["W_HFM"][away], rtol=1e-4)
    np.testing.assert_array_equal(one["p_Int"], columns(prepared)["p_Int"])
