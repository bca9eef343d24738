"""Two faults at once on the made-up engine: found, named, measured; one fault stays one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest
from made_up_engine import HYPOTHESES, STAGES, drive, fitted_to

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.additive import Additive
from stages.pair_search import Pair
from stages.pairs import Pairs
from stages.stage import ANALYSIS, Stage, connected, transform

SINGLES = [f"p.{f}" for f in (*HYPOTHESES, "unknown")]
PAIRS = ["p.flow_gain+leak", "p.flow_gain+pressure_gain", "p.leak+pressure_gain"]


@pytest.fixture(scope="module")
def fitted() -> list[Stage]:
    return fitted_to((*STAGES, Pairs()))


def late(fitted: list[Stage], **faults: float) -> pl.DataFrame:
    """Samples after an alarm of 200 s."""
    return transform(fitted, drive(7, **faults)).groups[ANALYSIS].frame.filter(pl.col("time") > 400)


@pytest.mark.parametrize(
    ("faults", "name", "sizes"),
    [
        ({"flow": 0.05, "pressure": -0.04}, "flow_gain+pressure_gain", (0.05, -0.04)),
        ({"flow": -0.05, "leak": 2.0}, "flow_gain+leak", (-0.05, 2.0)),
        ({"pressure": 0.05, "leak": 2.0}, "leak+pressure_gain", (2.0, 0.05)),
    ],
)
def test_two_faults_are_named_and_measured(
    fitted: list[Stage], faults: dict[str, float], name: str, sizes: tuple[float, float]
) -> None:
    last = late(fitted, **faults).row(-1, named=True)
    assert last[f"p.{name}"] > 0.9
    assert last[f"evidence.{name}"] > max(
        last[f"evidence.{f}"] for f in ("flow_gain", "pressure_gain", "leak")
    )
    for fault, size in zip(name.split("+"), sizes, strict=True):
        found, sd = last[f"size.{name}.{fault}"], last[f"size_sd.{name}.{fault}"]
        assert found == pytest.approx(size, rel=0.15)
        assert abs(found - size) < 5 * sd


@pytest.mark.parametrize("fault", [{"flow": 0.05}, {"pressure": -0.03}, {"leak": 2.0}])
def test_one_fault_is_not_two(fitted: list[Stage], fault: dict[str, float]) -> None:
    frame = late(fitted, **fault)
    assert frame.select(pl.max_horizontal(PAIRS).max()).item() < 0.2
    total = frame.select(pl.sum_horizontal(*SINGLES, *PAIRS)).to_series()
    np.testing.assert_allclose(total, 1.0, atol=1e-5)


def test_a_fault_that_grows_is_not_two(fitted: list[Stage]) -> None:
    frame = drive(9).groups[ANALYSIS].frame
    size = np.clip((frame["time"].to_numpy() - 200) / 200, 0, 1) * 0.1
    log = Log("grows", {ANALYSIS: Group(ANALYSIS, frame.with_columns(p=pl.col("p") * (1 + size)))})
    out = transform(fitted, log).groups[ANALYSIS].frame.filter(pl.col("time") > 230)
    assert out.select(pl.max_horizontal(PAIRS).max()).item() < 0.5


def test_a_pair_that_was_near_is_looked_for_again(
    fitted: list[Stage], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = []
    search = Pairs._search

    def noted(self: Pairs, *seen: Any) -> dict[str, Pair]:
        looks.append((self, *seen))
        return search(self, *seen)

    monkeypatch.setattr(Pairs, "_search", noted)
    late(fitted, flow=0.05, pressure=-0.04)
    stage, window, some, before = looks[-1]
    monkeypatch.setattr(Additive, "pair", lambda *_: (0.0, (0.05, -0.04)))
    assert search(stage, window, some, before)
    assert not search(stage, window, some, {})
    far = {name: replace(pair, height=-11.0) for name, pair in before.items()}
    assert not search(stage, window, some, far)


def test_without_an_alarm_nothing_is_said(fitted: list[Stage]) -> None:
    frame = late(fitted)
    assert frame.select(pl.max_horizontal(*SINGLES, *PAIRS).max()).item() == 0.0
    assert (frame["evidence.flow_gain+leak"] <= frame["evidence.leak"].max()).all()


def test_blocks_do_not_matter(fitted: list[Stage]) -> None:
    log = drive(8, flow=0.05, leak=2.0)
    whole, parts = (transform(fitted, log, block).groups[ANALYSIS].frame for block in (None, 7.3))
    for column in (c for c in whole.columns if "+" in c):
        np.testing.assert_allclose(whole[column], parts[column], rtol=1e-4, atol=1e-6)


def test_pairs_that_look_the_same_share_their_probability() -> None:
    alike = fitted_to((*STAGES, Pairs(alike=(("flow_gain", "pressure_gain", "leak"),))))
    last = late(alike, flow=0.05, pressure=-0.04).row(-1, named=True)
    assert (
        len({last[f"p.{p}"] for p in ("flow_gain+leak", "flow_gain+pressure_gain", "leak+pressure_gain")})
        == 1
    )


@pytest.mark.parametrize(
    ("sizes", "mirrors"), [((0.05, 0.04), True), ((0.05, -0.05), False), ((0.05, 0.09), False)]
)
def test_two_of_three_alike_that_say_no_more_than_the_third_are_none(
    fitted: list[Stage], sizes: tuple[float, float], mirrors: bool
) -> None:
    pairs, found = fitted[-1], Pair(0.0, 0.0, 0.0, sizes, (0.01, 0.01))
    assert isinstance(pairs, Pairs)
    alike = replace(pairs, alike=(("flow_gain", "pressure_gain", "leak"),))
    assert alike._mirrors("leak+pressure_gain", found, "flow_gain", -0.05) is mirrors
    assert not alike._mirrors("leak+pressure_gain", found, "leak", -0.05)
    assert not pairs._mirrors("leak+pressure_gain", found, "flow_gain", -0.05)


def test_the_more_two_faults_explain_the_less_sure_is_a_small_difference(fitted: list[Stage]) -> None:
    pairs = fitted[-1]
    assert isinstance(pairs, Pairs)
    values = {"detection": np.ones(4)}
    values |= {"evidence." + f: np.zeros(4) for f in (*HYPOTHESES, "unknown")}
    gains = np.array([20.0, 1e2, 1e3, 1e4])
    found: dict[int, dict[str, Pair]] = {}
    for row, gain in enumerate(gains):
        ahead = Pair(float(gain), -np.inf, 0.0, (0.05, 0.05), (0.01, 0.01))
        found[row] = {"leak+pressure_gain": ahead, "flow_gain+leak": replace(ahead, height=float(gain) - 10)}
    out = pairs._columns(values, found, {row: {} for row in range(4)})
    p = out["p.flow_gain+leak"]
    assert (np.diff(p) > 0).all()
    assert p[0] < 0.06 < 0.3 < p[-1] < out["p.leak+pressure_gain"][-1]


def test_the_more_there_is_to_explain_the_less_sure_is_a_small_difference(fitted: list[Stage]) -> None:
    pairs, behind = fitted[-1], Pair(-10.0, -np.inf, 0.0, (0.05, 0.05), (0.01, 0.01))
    assert isinstance(pairs, Pairs)
    rough = {f: replace(h, inexact=0.03) for f, h in HYPOTHESES.items()}
    pairs = pairs.connect([*pairs.before[:-1], replace(pairs.isolate, hypotheses=rough)])
    best = np.array([0.0, 1e2, 1e3, 1e4])
    values = {"detection": np.ones(4), "evidence.flow_gain": best}
    values |= {"evidence." + f: best - 50 * (1 + best / 10) for f in ("pressure_gain", "leak", "unknown")}
    found = pairs._columns(values, {0: {"leak+pressure_gain": behind}}, {0: {}})
    p = found["p.leak+pressure_gain"]
    assert (np.diff(p) > 0).all()
    assert p[0] < 0.01 < 0.1 < p[-1] < found["p.flow_gain"][-1]


def test_mistakes() -> None:
    with pytest.raises(RecipeError, match="right after the stage isolate"):
        _ = Pairs().isolate
    stages = connected([*fitted_to(STAGES), Pairs(faults=("leek",))])
    assert isinstance(stages[-1], Pairs)
    with pytest.raises(RecipeError, match=r"no fault 'leek' in isolate.*leak"):
        _ = stages[-1].pairs
