"""What a log would have shown, from likelihoods written down directly."""

from __future__ import annotations

import numpy as np
import pytest

from stages.evidence import QUANTILE, note_detectable
from stages.hypotheses import Hypothesis
from stages.size_grid import refined_grid

THRESHOLD = 12.0
NEEDED = 0.5 * (QUANTILE + np.sqrt(QUANTILE**2 + 2 * THRESHOLD)) ** 2


def least(hypothesis: Hypothesis, gain: list[float]) -> float:
    """``gain``: by how much being healthy is likelier than each of the hypothesis' sizes."""
    grid = refined_grid([hypothesis], [hypothesis.sizes], 0, 1)
    detectable = np.full(1, np.inf)
    note_detectable(np.array([0.0, *(-g for g in gain), 0.0]), np.array([THRESHOLD]), grid, detectable)
    return float(detectable[0])


def test_the_gain_goes_with_the_square_of_the_size() -> None:
    gain = Hypothesis(undo={"W": "W / (1 + theta)"}, sizes=(0.1, 0.2))
    assert least(gain, [1.0, 4 * NEEDED]) == pytest.approx(0.1)
    assert least(gain, [4 * NEEDED, 16 * NEEDED]) == pytest.approx(0.05)


def test_what_would_not_have_been_seen_has_no_size() -> None:
    assert least(Hypothesis(undo={"W": "W - theta"}, sizes=(1.0, 2.0)), [1.0, 0.9 * NEEDED]) == np.inf


def test_a_stuck_valve_is_not_scaled() -> None:
    """Half of a valve that is stuck at 60 % is not one that is stuck at 30 %."""
    stuck = Hypothesis(undo={"egr": "theta"}, sizes=(30.0, 60.0), unit="%", from_zero=False)
    assert least(stuck, [1.0, 100 * NEEDED]) == 60.0
