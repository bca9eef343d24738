from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from viz import colours

RECIPES = {
    "air path": (
        "none",
        "unknown",
        "maf_gain",
        "boost_pressure_gain",
        "intake_pressure_gain",
        "boost_leak",
        "intake_leak",
        "intake_temperature_gain",
        "egr_stuck_open",
        "egr_stuck_closed",
        "sensor_stuck",
        "sensor_noise",
        "sensor_offset",
    ),
    "throttle": (
        "none",
        "unknown",
        "tps_time_constant",
        "tps_gain",
        "motor_torque_constant",
        "back_emf_constant",
    ),
}

# Viénot, Brettel, Mollon 1999: linear RGB as seen without red or without green cones.
PROTANOPE = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
DEUTERANOPE = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])


def distance(a: colours.Colour, b: colours.Colour, eye: np.ndarray) -> float:
    seen = [eye @ (np.array(c) / 255.0) ** 2.2 for c in (a, b)]
    return float(np.linalg.norm(np.clip(seen[0], 0, 1) ** (1 / 2.2) - np.clip(seen[1], 0, 1) ** (1 / 2.2)))


@pytest.mark.parametrize("eye", [np.eye(3), PROTANOPE, DEUTERANOPE], ids=["all cones", "no red", "no green"])
@pytest.mark.parametrize("recipe", RECIPES)
def test_faults_of_a_recipe_are_told_apart(recipe: str, eye: np.ndarray) -> None:
    for a, b in combinations(RECIPES[recipe], 2):
        assert distance(colours.of_fault(a), colours.of_fault(b), eye) > 0.1, (a, b)


@pytest.mark.parametrize("eye", [np.eye(3), PROTANOPE, DEUTERANOPE], ids=["all cones", "no red", "no green"])
def test_exceedances_stand_out_from_the_line_they_are_on(eye: np.ndarray) -> None:
    assert distance(colours.EXCEEDANCE, colours.SKY_BLUE, eye) > 0.3


def test_series_colours_repeat_after_the_cycle() -> None:
    assert len(set(colours.CYCLE)) == len(colours.CYCLE)
    assert colours.of_index(len(colours.CYCLE)) == colours.of_index(0)


def test_ramp_brightens_and_shows_what_is_missing() -> None:
    seen = colours.ramp(np.array([0.0, 1.0, 2.0, np.nan]))
    assert (np.diff(seen[:3].astype(int).sum(axis=1)) > 0).all()
    assert tuple(seen[3]) == colours.GREY
    assert colours.ramp(np.array([np.nan])).tolist() == [list(colours.GREY)]
    assert len(np.unique(colours.ramp(np.array([5.0, 5.0])), axis=0)) == 1
