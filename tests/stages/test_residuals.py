from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError
from ingest.log import Group, Log
from stages.gate import GATE
from stages.residuals import Residuals
from stages.stage import ANALYSIS, add_columns, columns, transform


def block(n: int = 20_000, **more: np.ndarray) -> Log:
    rng = np.random.default_rng(0)
    regime = rng.integers(0, 3, n)
    gate = np.where(np.arange(n) % 2, 1.0, 0.25)
    spread = np.array([0.1, 0.2, 0.4])[regime]
    f = rng.uniform(1, 2, n)
    columns_ = {
        "time": np.arange(n) / 2,
        "y": f + rng.normal(0, spread / np.sqrt(gate)),
        "f": f,
        "regime": regime,
        GATE: gate,
    }
    return Log("x", {ANALYSIS: Group(ANALYSIS, pl.DataFrame(columns_ | more))})


def test_spread_per_regime_and_away_from_rest() -> None:
    log = block()
    out = columns(transform([Residuals(residuals={"r": "y - f"}).fit([log])], log))
    for m, expected in enumerate((0.1, 0.2, 0.4)):
        here = out["regime"] == m
        assert np.mean(out["sigma.r"][here & (out[GATE] == 1)]) == pytest.approx(expected, rel=0.05)
        assert np.std(out["z.r"][here]) == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(out["z.r"] * out["sigma.r"], out["residual.r"])


def test_outliers_do_not_widen_it_and_the_floor_holds() -> None:
    log = block()
    y = columns(log)["y"].copy()
    y[::100] += 50.0
    wide = Residuals(residuals={"r": "y - f"}, floor={"r": 0.15}).fit([block(y=y)])
    assert wide.learned["sigma"][0, 0] == 0.15
    assert wide.learned["sigma"][0, 2] == pytest.approx(0.4, rel=0.1)


def test_a_regime_never_met_has_the_overall_spread() -> None:
    stage = Residuals(residuals={"r": "y - f"}).fit([block()])
    out = columns(transform([stage], block(regime=np.full(20_000, 9), gate=np.ones(20_000))))
    assert 0.2 < out["sigma.r"][0] < 0.3


def test_doubts_of_relations_are_inherited() -> None:
    log = add_columns(block(), {"f.sd": np.full(20_000, 0.3)})
    stage = Residuals(residuals={"r": "y - f", "q": "ln(f)", "s": "2 * y"}).fit([log])
    out = columns(transform([stage], log))
    np.testing.assert_allclose(out["model_sd.r"], 0.3)
    np.testing.assert_allclose(out["model_sd.q"], np.log1p(0.3 / out["f"]))
    assert (out["model_sd.s"] == 0).all()


def test_a_residual_without_values_is_named() -> None:
    with pytest.raises(LogError, match="'r' has no value"):
        Residuals(residuals={"r": "ln(-y)"}).fit([block(y=np.ones(20_000))])
