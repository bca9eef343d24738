"""What a selection was decided on, against what the data were made of."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from numpy.typing import NDArray

from stages.genes import Space
from stages.portrait import portrait
from stages.results import RESIDUAL_EDGES, Chosen
from stages.selecting import Search, select

Array = NDArray[np.float64]
NAMES = ("y", "u", "v")
SPACE = Space.of(["y"], ["u", "v"], na_max=2, nb_max=2, nk_max=3)


def made(n: int = 4000) -> Array:
    """y(t) = 0.5 y(t-1) + u(t-2) |u(t-2)| + e; v is u mixed with noise."""
    rng = np.random.default_rng(3)
    u, e = rng.normal(size=n), 0.1 * rng.normal(size=n)
    v = 0.6 * u + 0.8 * rng.normal(size=n)
    y = np.zeros(n)
    for t in range(2, n):
        y[t] = 0.5 * y[t - 1] + u[t - 2] * abs(u[t - 2]) + e[t]
    return np.column_stack([y, u, v])


def drawn(z: Array, search: Search) -> Chosen:
    parts = [z[:300], z[300:]]
    return portrait("f", parts, NAMES, "y", select(parts, NAMES, "y", SPACE, search))


@pytest.mark.parametrize("search", ["evidence", "exhaustive", "genetic"])
def test_of_every_search(search: str) -> None:
    z = made()
    one = drawn(z, Search(search=search))  # type: ignore[arg-type]
    if search == "evidence":
        assert one.taken == ("y(t-1)", "u(t-2)")
    assert one.proven == (search != "evidence")  # so few genes that the genetic search saw all
    assert list(one.scores) == sorted(one.scores)
    assert one.history[-1] == pytest.approx(one.scores[0], abs=1e-3)
    assert list(one.history) == sorted(one.history, reverse=True)
    C, names = np.array(one.correlation), [*one.candidates, "y"]
    np.testing.assert_allclose(np.diag(C), 1.0, atol=1e-3)
    expected = np.corrcoef(z[2:, 0], z[:-2, 1])[0, 1]
    assert C[names.index("u(t-2)"), -1] == pytest.approx(expected, abs=0.02)
    assert C[names.index("u(t-1)"), names.index("v(t-1)")] == pytest.approx(0.6, abs=0.05)
    assert Chosen.from_json(json.loads(json.dumps(asdict(one)))) == one


def test_the_residual_is_white_and_normal_where_the_noise_is() -> None:
    one = drawn(made(), Search())
    share = np.array(one.residual) * np.diff(RESIDUAL_EDGES)
    assert share.sum() == pytest.approx(1.0, abs=0.01)
    middle = 0.5 * (RESIDUAL_EDGES[1:] + RESIDUAL_EDGES[:-1])
    assert share @ middle**2 == pytest.approx(1.0, abs=0.1)
    assert np.abs(one.residual - np.exp(-0.5 * middle**2) / np.sqrt(2 * np.pi)).max() < 0.07
    assert np.mean(one.spectrum) == pytest.approx(1.0, abs=0.05)
    assert min(one.spectrum) > 0.5
    assert max(one.spectrum) < 2.0


def test_a_past_that_is_left_out_shows_in_the_spectrum() -> None:
    """Without y(t-1) among the candidates, what its pole 0.5 makes of the noise is left: 9 times the power at
    rest of that at the highest frequency."""
    z, space = made(), Space.of([], ["u", "v"], na_max=0, nb_max=2, nk_max=3)
    one = portrait("f", [z], NAMES, "y", select([z], NAMES, "y", space))
    assert np.mean(one.spectrum[:10]) > 4 * np.mean(one.spectrum[-10:])


def test_where_nothing_is_selected() -> None:
    rng = np.random.default_rng(0)
    one = drawn(rng.normal(size=(1000, 3)), Search())
    assert one.taken == ()
    assert np.mean(one.spectrum) == pytest.approx(1.0, abs=0.1)
