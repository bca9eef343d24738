"""A made-up controller that opens a valve for what is wanted, further as the system wears."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ingest.errors import RecipeError
from stages.witness import LIMIT, Witness, contradiction, swear_in

Array = NDArray[np.float64]
WITNESS = Witness(output="ln(valve)", inputs=("speed", "wanted / 10"), wear={"worn": 0.2}, nodes=4)
BETWEEN = 0.004  # standard deviation between drives


def drive(seed: int, worn: float = 0.0) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    speed, wanted = rng.uniform(1, 3, 300), rng.uniform(10, 20, 300)
    level = 0.3 * speed + 0.02 * wanted + 0.2 * worn + BETWEEN * rng.normal() + 0.01 * rng.normal(size=300)
    return {"time": np.arange(300.0), "speed": speed, "wanted": wanted, "valve": np.exp(level),
            "gate": rng.uniform(0.2, 1.0, 300)}  # fmt: skip


def test_what_wear_adds_is_heard() -> None:
    sworn = swear_in(WITNESS, [drive(i) for i in range(30)])
    assert sworn is not None
    assert sworn.sd == pytest.approx(BETWEEN, rel=0.35)
    worn = np.mean([sworn.mean(drive(100 + i, 0.05)) for i in range(30)])
    assert worn == pytest.approx(0.2 * 0.05, abs=3 * BETWEEN / np.sqrt(30))
    assert np.isnan(sworn.mean({k: v[:0] for k, v in drive(1).items()}))
    far = {**drive(1), "speed": np.full(300, 30.0)}
    assert np.isnan(sworn.mean(far))


@pytest.mark.parametrize("lost", [{}, {"valve": np.full(300, np.nan)}])
def test_a_witness_without_its_signals_says_nothing(lost: dict[str, Array]) -> None:
    deaf = {k: v for k, v in drive(1).items() if k != "valve"} | lost
    assert swear_in(WITNESS, [deaf] * 10) is None


def test_wear_that_is_there_is_confirmed_and_wear_that_is_not_is_denied() -> None:
    sworn = swear_in(WITNESS, [drive(i) for i in range(30)])
    assert sworn is not None
    grown = 0.08 * np.arange(100) / 100
    told = []
    for there in (grown, 0 * grown):
        left = np.array([sworn.mean(drive(200 + i, x)) for i, x in enumerate(there)])
        told.append(contradiction(left, 0.2 * grown, sworn.sd, sworn.drives, WITNESS.inexact))
    assert (told[0] < LIMIT).all()
    assert told[1][-1] > LIMIT


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(5, 60), st.integers(1, 80))
def test_without_wear_z_has_a_standard_normal_distribution(seed: int, drives: int, count: int) -> None:
    """The centre of the commissioning has an error of its own, common to all drives."""
    rng = np.random.default_rng(seed)
    left = 0.3 * (rng.normal(size=(300, 1)) / np.sqrt(drives) + rng.normal(size=(300, count)))
    z = [contradiction(y, np.zeros(count), 0.3, drives, 0.2)[-1] for y in left]
    assert np.mean(z) == pytest.approx(0.0, abs=0.25)
    assert np.std(z) == pytest.approx(1.0, abs=0.2)


def test_a_drive_that_is_not_heard_changes_nothing_but_the_memory() -> None:
    left, expected = np.array([0.1, np.nan, 0.2]), np.array([0.3, 0.4, 0.5])
    z = contradiction(left, expected, 0.1, 20, 0.0)
    assert np.isfinite(z).all()
    assert abs(z[1] - z[0]) < 0.1
    assert contradiction(np.array([np.nan]), np.array([1.0]), 0.1, 20, 0.2)[0] == 0.0


def test_settings_are_checked() -> None:
    with pytest.raises(RecipeError, match="needs inputs"):
        Witness(output="valve", inputs=(), wear={"worn": 1.0})
    with pytest.raises(RecipeError):
        Witness(output="valve +", inputs=("speed",), wear={"worn": 1.0})
