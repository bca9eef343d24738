from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.detect import MEAN, MEAN_SD
from stages.residuals import RESIDUAL, SIGMA
from stages.results import DETECTION
from stages.signatures import Signatures
from stages.stage import ANALYSIS, columns, transform

TABLE_5_2 = {
    "maf_gain": {"bst": "x", "cyl": "x"},
    "boost_pressure_gain": {"bst": "x", "int": "x"},
    "intake_pressure_gain": {"bst": "x", "int": "x", "cyl": "x"},
    "intake_leak": {"int": "+", "cyl": "+"},
}


def run(stage: Signatures, *z: float, alarm: bool = True) -> dict[str, float]:
    names = ("bst", "int", "cyl")
    data: dict[str, list[float]] = {"time": [0.0], DETECTION: [float(alarm)]}
    for r, value in zip(names, z, strict=True):
        data |= {RESIDUAL + r: [0.0], MEAN + r: [2.0 * value], MEAN_SD + r: [2.0]}
    out = columns(transform([stage], Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame(data))})))
    return {k: float(v[0]) for k, v in out.items() if k.startswith(("evidence.", "p."))}


def most_probable(p: dict[str, float]) -> str:
    return max((k for k in p if k.startswith("p.")), key=lambda k: p[k]).removeprefix("p.")


def test_evidence_is_the_ratio_of_marginal_likelihoods() -> None:
    z = np.array([2.0, -1.0, 3.0])
    out = run(Signatures(table=TABLE_5_2, reach=4.0), *z)
    for fault, marks in list(TABLE_5_2.items())[:3]:
        prior = [16.0 if r in marks else 0.0 for r in ("bst", "int", "cyl")]
        ratio = (
            multivariate_normal(np.zeros(3), np.diag(1 + np.array(prior))).logpdf(z) - norm.logpdf(z).sum()
        )
        assert out[f"evidence.{fault}"] == pytest.approx(ratio, rel=1e-5)


def test_a_signed_mark_integrates_over_its_side_only() -> None:
    mu = np.linspace(0, 60, 60_001)
    density = 2 * norm.pdf(mu, scale=4.0)
    for z in (3.0, -3.0):
        marginal = np.trapezoid(density * norm.pdf(z - mu), mu)
        out = run(Signatures(table={"leak": {"int": "+"}}, reach=4.0), 0.0, z, 0.0)
        assert out["evidence.leak"] == pytest.approx(np.log(marginal / norm.pdf(z)), abs=1e-4)


@pytest.mark.parametrize(
    ("z", "fault"),
    [
        ((9, 0, 9), "maf_gain"),
        ((-9, 0, -9), "maf_gain"),
        ((9, 9, 0), "boost_pressure_gain"),
        ((9, -9, 9), "intake_pressure_gain"),
        ((0, 9, 9), "intake_leak"),
        ((0, -9, -9), "intake_pressure_gain"),
        ((0, -9, 0), "boost_pressure_gain"),
    ],
)
def test_table_5_2(z: tuple[float, float, float], fault: str) -> None:
    assert most_probable(run(Signatures(table=TABLE_5_2), *z)) == fault


def test_unknown_where_no_row_fits() -> None:
    table = {"one": {"bst": "x"}, "two": {"int": "x"}}
    assert most_probable(run(Signatures(table=table), 9, 9, 0)) == "unknown"
    assert most_probable(run(Signatures(table=table), 9, 0, 0)) == "one"


def test_probabilities_sum_to_one_during_an_alarm_only() -> None:
    for alarm, total in ((True, 1.0), (False, 0.0)):
        out = run(Signatures(table=TABLE_5_2), 3, 1, -2, alarm=alarm)
        assert sum(v for k, v in out.items() if k.startswith("p.")) == pytest.approx(total, abs=1e-6)


SHAPED = Signatures(
    table={"gain": {"cyl": "x"}, "leak": {"cyl": "x"}, "other": {"bst": "x"}},
    shapes={"gain": {"cyl": "W"}, "leak": {"cyl": "sqrt(dp)"}},
)


def distributed(shape: NDArray[np.float64], before: NDArray[np.float64]) -> dict[str, float]:
    """The last of 200 s, in alarm from the half on; until then the residual has the shape ``before``."""
    t = np.arange(0.0, 200.0, 0.5)
    dice, late = np.random.default_rng(3), t >= 100
    W, dp = dice.uniform(20, 80, t.size), dice.uniform(0, 100, t.size)
    e = np.where(late, shape[0] * W + shape[1] * np.sqrt(dp), before[0] * W + before[1] * np.sqrt(dp))
    data = {"time": t, "W": W, "dp": dp, DETECTION: late.astype(float)}
    for r, x in (("bst", 0.0 * t), ("cyl", e + dice.normal(0, 1, t.size))):
        mean = np.full(t.size, x[late].mean())
        data |= {
            RESIDUAL + r: x,
            SIGMA + r: np.ones(t.size),
            MEAN + r: mean,
            MEAN_SD + r: np.full(t.size, 0.1),
        }
    out = columns(transform([SHAPED], Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame(data))})))
    return {k: float(v[-1]) for k, v in out.items() if k.startswith(("evidence.", "p."))}


@pytest.mark.parametrize(("shape", "fault"), [((0.05, 0.0), "gain"), ((0.0, 0.4), "leak")])
def test_faults_of_one_row_are_told_apart_by_how_the_residual_is_distributed(
    shape: tuple[float, float], fault: str
) -> None:
    for before in ((0.0, 0.0), (-0.3, 0.0), (0.0, -2.0)):  # what was before the alarm does not count
        found = distributed(np.array(shape), np.array(before))
        assert most_probable(found) == fault
        assert found[f"p.{fault}"] > 0.99


def test_the_likelier_shape_is_so_by_its_least_squares() -> None:
    t = np.arange(0.0, 200.0, 0.5)
    dice = np.random.default_rng(3)
    W, dp = dice.uniform(20, 80, t.size), dice.uniform(0, 100, t.size)
    e = 0.05 * W
    noise = dice.normal(0, 1, t.size)
    late = t >= 100
    rest = [np.linalg.lstsq(h[late, None], (e + noise)[late], rcond=None)[1][0] for h in (W, np.sqrt(dp))]
    found = distributed(np.array([0.05, 0.0]), np.zeros(2))
    share = 0.5 / SHAPED.correlation_s  # of an independent sample that each is
    assert found["evidence.gain"] - found["evidence.leak"] == pytest.approx(
        0.5 * share * (rest[1] - rest[0]), rel=1e-5
    )


def test_mistakes_in_the_table() -> None:
    with pytest.raises(RecipeError, match=r"leak has a shape of 'bst', which its row does not mark.*cyl"):
        Signatures(table={"leak": {"cyl": "x"}}, shapes={"leak": {"bst": "W"}})
    with pytest.raises(RecipeError, match="gain has a shape"):
        Signatures(table={"leak": {"cyl": "x"}}, shapes={"gain": {"cyl": "W"}})
    with pytest.raises(RecipeError, match=r"leak: marks must be one of.*'y'"):
        Signatures(table={"leak": {"r": "y"}})
    with pytest.raises(RecipeError, match="leak marks no residual"):
        Signatures(table={"leak": {"r": "0"}})
