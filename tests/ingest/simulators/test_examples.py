from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import DynoscopeError
from ingest.log import Log
from ingest.simulators.examples import STRUCTURES, example1, example2, simulate_example

Array = NDArray[np.float64]


def lag(x: Array, k: int) -> Array:
    return x[10 - k : len(x) - k]


def test_example_1_obeys_its_equations() -> None:
    c = example1(500, 0.0, 3)
    y1, y2, u1, u2 = (c[n] for n in ("y1", "y2", "u1", "u2"))
    np.testing.assert_allclose(
        lag(y1, 0),
        0.8 * lag(y1, 1) - 0.1 * lag(y2, 1) + lag(u1, 2) + 0.4 * lag(u1, 2) ** 2
        - 1.2 * lag(u1, 1) * lag(u2, 2),
    )  # fmt: skip
    np.testing.assert_allclose(
        lag(y2, 0), 0.5 * lag(y2, 1) + 0.5 * lag(y2, 2) * lag(u2, 1) ** 2 + lag(u2, 2) + lag(u1, 1) ** 2
    )


def test_example_2_obeys_its_equation_and_its_noise() -> None:
    c = example2(4000, 1.0, 3)
    y, u1, u2 = c["y"], c["u1"], c["u2"]
    e = lag(y, 0) - 0.8 * lag(y, 1) - lag(u1, 6) * lag(u2, 4) - 0.5 * np.exp(0.4 * lag(u1, 6) ** 2)
    assert e.std() == pytest.approx(0.05, rel=0.05)
    assert (c["u3"] - u1 - u2).std() == pytest.approx(0.1, rel=0.05)
    assert abs(u1).max() <= 0.5


@pytest.mark.parametrize("system", STRUCTURES)
def test_a_log_has_its_truth_and_depends_on_its_seed(system: str) -> None:
    one, again, other = (simulate_example(system, n=50, seed=s) for s in (1, 1, 2))
    assert one.equals(again)
    assert not one.equals(other)
    assert one.facts["structure"] == STRUCTURES[system]
    assert sorted(one.signals) == sorted(
        {*STRUCTURES[system], *next(iter(STRUCTURES[system].values()))["nb"]}
    )


def test_noise_does_not_shift_the_inputs() -> None:
    quiet, loud = (simulate_example("example1", n=50, noise=x) for x in (0.0, 2.0))

    def u(log: Log) -> list[float]:
        return list(log.values("u1"))

    assert u(quiet) == u(loud)


@pytest.mark.parametrize(("n", "noise", "seed"), [(0, 1.0, 0), (10, -1.0, 0), (10, 1.0, -1)])
def test_impossible_requests_are_refused(n: int, noise: float, seed: int) -> None:
    with pytest.raises(DynoscopeError, match="needs n >= 1"):
        simulate_example("example1", n=n, noise=noise, seed=seed)
