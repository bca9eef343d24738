from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ingest.errors import RecipeError
from stages.formula import Formula


@given(st.floats(0.1, 1e6), st.floats(0.1, 1e6))
def test_agrees_with_numpy(a: float, b: float) -> None:
    value = Formula("ln(a / b) + sqrt(a) ** 2 - abs(-b) + max(a, b)")({"a": a, "b": b})
    assert value == pytest.approx(np.log(a / b) + np.sqrt(a) ** 2 - b + max(a, b))


def test_undefined_is_missing() -> None:
    value = Formula("ln(x) / x")({"x": np.array([-1.0, 0.0, 1.0])})
    np.testing.assert_array_equal(value, [np.nan, np.nan, 0.0])


@pytest.mark.parametrize(
    "text",
    ["x +", "__import__('os')", "x.real", "[x]", "x if x else 1", "lambda: 1", "'a'", "sqrt(a=x)", "x := 1"],
)
def test_refuses_all_but_arithmetic(text: str) -> None:
    with pytest.raises(RecipeError):
        Formula(text)


def test_names_the_near_ones() -> None:
    with pytest.raises(RecipeError, match="did you mean sqrt"):
        Formula("sqr(x)")
    with pytest.raises(RecipeError, match=r"'p_Bts'.*did you mean p_Bst"):
        Formula("p_Bts + 1")({"p_Bst": 1.0})
