"""Isolation by undoing, on a made-up engine: two relations, three faults that move them in different ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from made_up_engine import HYPOTHESES, STAGES, drive, fitted_to

from ingest.errors import RecipeError
from ingest.log import Group, Log
from stages.hypotheses import Hypothesis
from stages.isolate import Isolate
from stages.regressors import Regressors
from stages.relation import Relation
from stages.relations import Relations
from stages.residuals import Residuals
from stages.stage import ANALYSIS, Stage, connected, transform

PROBABILITIES = [f"p.{f}" for f in (*HYPOTHESES, "unknown")]


def resting_drive(seed: int) -> pl.DataFrame:
    """Samples of an engine that idles."""
    rng, t = np.random.default_rng(seed), np.arange(0, 400, 0.5)
    W = 40 * 1.5 * 2.0 * (1 - 0.05 * 2.0)
    noise = {k: np.exp(rng.normal(0, sd, t.size)) for k, sd in (("W", 0.005), ("p", 0.002), ("F", 0.005))}
    return pl.DataFrame(
        {
            "time": t,
            "W": W * noise["W"],
            "p": 1.5 * noise["p"],
            "n": np.full(t.size, 2.0),
            "F": W / 20 * noise["F"],
            "leak": np.zeros(t.size),
        }
    )


def drive_with(frame: pl.DataFrame, **factor: np.ndarray) -> Log:
    frame = frame.with_columns(pl.col(c) * f for c, f in factor.items())
    return Log("rest", {ANALYSIS: Group(ANALYSIS, frame)})


@pytest.fixture(scope="module")
def fitted() -> list[Stage]:
    return fitted_to(STAGES)


def samples(fitted: list[Stage], log: Log) -> pl.DataFrame:
    return transform(fitted, log).groups[ANALYSIS].frame


@pytest.mark.parametrize(
    ("fault", "size"),
    [
        ("flow_gain", 0.05),
        ("flow_gain", -0.03),
        ("pressure_gain", 0.05),
        ("pressure_gain", -0.03),
        ("leak", 2.0),
    ],
)
def test_the_fault_is_named_soon_and_measured(fitted: list[Stage], fault: str, size: float) -> None:
    kind = fault.split("_")[0]
    frame = samples(fitted, drive(7, **{kind: size}))
    alarm = frame.filter(pl.col("detection") == 1)
    assert 200.0 < alarm["time"][0] < 215.0
    assert frame.filter(pl.col("time") > alarm["time"][0])["detection"].mean() == 1.0
    late = frame.filter(pl.col("time") > 300)
    assert late[f"p.{fault}"].min() > 0.9  # type: ignore[operator]
    assert late[f"size.{fault}"][-1] == pytest.approx(size, rel=0.1)
    assert abs(late[f"size.{fault}"][-1] - size) < 4 * late[f"size_sd.{fault}"][-1]
    total = alarm.select(pl.sum_horizontal(PROBABILITIES)).to_series()
    np.testing.assert_allclose(total, 1.0, atol=1e-6)


def test_healthy_drives_stay_quiet(fitted: list[Stage]) -> None:
    for seed in range(20, 30):
        frame = samples(fitted, drive(seed))
        assert frame["detection"].sum() == 0
        assert frame.select(pl.sum_horizontal(PROBABILITIES).sum()).item() == 0


def test_what_no_hypothesis_explains_is_unknown(fitted: list[Stage]) -> None:
    log = drive(8)
    frame = log.groups[ANALYSIS].frame.with_columns(
        F=pl.when(pl.col("time") >= 200).then(pl.col("F") * 1.15).otherwise(pl.col("F"))
    )
    log = replace(log, groups={ANALYSIS: Group(ANALYSIS, frame)})
    assert samples(fitted, log)["p.unknown"][-1] > 0.9


@pytest.mark.parametrize("size", [0.03, 0.09])
def test_the_alarm_ends_with_the_fault(fitted: list[Stage], size: float) -> None:
    """A large fault is over as soon as a small one, and comes back under its name."""
    broken, whole = drive(9, flow=size).groups[ANALYSIS].frame, drive(9).groups[ANALYSIS].frame
    there = pl.col("time").is_between(400, 450, closed="left").not_()
    frame = pl.concat([broken.filter(there), whole.filter(~there)]).sort("time")
    out = samples(fitted, Log("x", {ANALYSIS: Group(ANALYSIS, frame)}))
    on = out["detection"].to_numpy() == 1
    ends = out["time"].to_numpy()[:-1][on[:-1] & ~on[1:]]
    assert len(ends) == 1
    assert 405 <= ends[0] < 415
    again = out.filter((pl.col("time") > 480) & (pl.col("detection") == 1))
    assert again["p.flow_gain"].min() > 0.9  # type: ignore[operator]


@pytest.mark.parametrize("size", [-0.09, 0.03, 0.09])
def test_a_fault_keeps_its_name_and_size(fitted: list[Stage], size: float) -> None:
    """What came before the alarm is not taken for another size of it."""
    out = samples(fitted, drive(5, pressure=size)).filter(pl.col("time") > 220)
    assert out["p.pressure_gain"].min() > 0.9  # type: ignore[operator]
    assert out["size.pressure_gain"].to_numpy() == pytest.approx(size, rel=0.15)


def test_a_fault_that_grows_is_judged_by_what_it_has_grown_to(fitted: list[Stage]) -> None:
    """Pressure gain from 0 to 10 % between 200 and 400 s."""
    t = drive(9).groups[ANALYSIS].frame["time"].to_numpy()
    size = np.clip((t - 200) / 200, 0, 1) * 0.1
    frame = drive(9).groups[ANALYSIS].frame.with_columns(p=pl.col("p") * (1 + size))
    out = samples(fitted, Log("x", {ANALYSIS: Group(ANALYSIS, frame)}))
    assert out["detection"].to_numpy()[t > 300].min() == 1
    late = out.filter(pl.col("time") > 450)
    assert late["p.pressure_gain"].min() > 0.9  # type: ignore[operator]
    assert late["size.pressure_gain"].to_numpy() == pytest.approx(0.1, rel=0.1)


def test_a_step_at_rest_is_seen_below_what_differs_from_run_to_run(fitted: list[Stage]) -> None:
    """Offsets of 5 % hide a gain of 3 % at first, but not its beginning while the engine idles."""
    resting = resting_drive(11)
    at_rest = drive_with(resting, W=np.where(resting["time"].to_numpy() >= 200, 1.03, 1.0))
    loose = {"r_air": {"1": 0.05}, "r_fuel": {"1": 0.05}}
    seen = {}
    for rest in ({}, {"n": 0.05, "F": 0.05}):
        stage = Isolate(hypotheses=HYPOTHESES, offsets=loose, rest=rest)
        stage = stage.fit([transform(fitted[:-1], drive(2))], [fitted[:-1]])
        stages = connected([*fitted[:-1], stage])
        assert samples(stages, drive_with(resting, W=np.ones(resting.height)))["detection"].sum() == 0
        seen[bool(rest)] = samples(stages, at_rest)
    assert seen[False].filter(pl.col("time") < 215)["detection"].sum() == 0
    alarm = seen[True].filter(pl.col("detection") == 1)
    assert 200 < alarm["time"][0] < 215
    alike = alarm["p.flow_gain"] + alarm["p.leak"]  # which of the two, an idling engine does not tell
    assert alike.min() > 0.95  # type: ignore[operator]
    assert alarm["p.flow_gain"].min() > 0.05  # type: ignore[operator]
    assert alarm["size.flow_gain"][0] == pytest.approx(0.03, abs=0.01)
    assert alarm["time"][-1] == seen[True]["time"][-1]


def test_a_change_within_a_drive_is_seen_below_what_differs_from_drive_to_drive(fitted: list[Stage]) -> None:
    """Sensors that are wrong by up to 2 % are healthy here; as much more within a drive are not."""
    logs = [
        drive(s, flow=x, at=0.0)
        for s, x in zip(range(60, 65), (-0.02, 0.016, 0.006, -0.012, 0.01), strict=True)
    ]
    stage = Isolate(hypotheses=HYPOTHESES, offsets={"r_air": {"1": 0.02}, "r_fuel": {"1": 0.02}})
    blocks = [transform(fitted[:-1], log) for log in logs]
    known = stage.fit(blocks, [fitted[:-1]] * len(blocks))
    unknown = replace(known, learned={**known.learned, "wander_sd": np.full(2, np.inf)})
    offset = drive(66, flow=-0.01, at=0.0).groups[ANALYSIS].frame
    late = offset["time"].to_numpy() >= 200
    seen = {}
    for stage in (known, unknown):
        stages = connected([*fitted[:-1], stage])
        assert samples(stages, drive_with(offset))["detection"].sum() == 0
        grown = samples(stages, drive_with(offset, W=np.where(late, 1.02, 1.0)))
        seen[stage is known] = grown.filter(pl.col("detection") == 1)
    assert 200 < seen[True]["time"][0] < 215
    assert seen[True]["p.flow_gain"][-1] > 0.9
    assert seen[True]["size.flow_gain"][-1] == pytest.approx(0.02, abs=0.005)
    assert seen[False].is_empty()


def test_what_is_called_detectable_is_detected(fitted: list[Stage]) -> None:
    least = samples(fitted, drive(12))["detectable.flow_gain"][-1]
    assert 0.001 < least < 0.05

    def alarms(size: float) -> list[bool]:
        return [
            bool((samples(fitted, drive(s, flow=size, at=0.0))["detection"] > 0).any()) for s in range(40, 48)
        ]

    found, missed = alarms(1.3 * least), alarms(0.4 * least)
    assert sum(found) >= 7
    assert sum(missed) <= 1


def test_where_nobody_has_been_nothing_is_said(fitted: list[Stage]) -> None:
    """Twice the trained speed, and a flow that no healthy engine shows: no hypothesis leads back from
    there."""
    log = drive(10, flow=0.3, at=0.0)
    frame = log.groups[ANALYSIS].frame.with_columns(pl.col("n") + 4.0)
    assert samples(fitted, Log("x", {ANALYSIS: Group(ANALYSIS, frame)}))["detection"].sum() == 0


def test_mistakes() -> None:
    with pytest.raises(RecipeError, match=r"two or more rising times, got \[10.0\]"):
        Isolate(hypotheses=HYPOTHESES, memories_s=(10.0,))
    with pytest.raises(RecipeError, match="at most two shapes"):
        Isolate(hypotheses=HYPOTHESES, offsets={"r": {"1": 1.0, "a": 1.0, "b": 1.0}})
    with pytest.raises(RecipeError, match="right after the stages"):
        _ = Isolate(hypotheses=HYPOTHESES).connect([STAGES[0]]).points


def test_one_sample_a_while_stands_for_those_beside_it() -> None:
    """Half of the samples, each twice its weight: the same fault, about as soon; in blocks as in one."""
    chain = fitted_to((*STAGES[:-1], replace(STAGES[-1], every_s=1.0, decide_s=1.0)))  # type: ignore[type-var]
    log = drive(7, flow=0.05)
    frame = samples(chain, log)
    assert 200.0 < frame.filter(pl.col("detection") == 1)["time"][0] < 218.0
    late = frame.filter(pl.col("time") > 300)
    assert late["p.flow_gain"].min() > 0.9  # type: ignore[operator]
    assert late["size.flow_gain"][-1] == pytest.approx(0.05, rel=0.1)
    in_blocks = transform(chain, log, 7.3).groups[ANALYSIS].frame
    np.testing.assert_array_equal(in_blocks["evidence.flow_gain"], frame["evidence.flow_gain"])
    all_of_them = samples(fitted_to(STAGES), log)
    ratio = late["evidence.flow_gain"][-1] / all_of_them["evidence.flow_gain"][-1]
    assert 0.7 < ratio < 1.4


def test_a_fault_of_what_is_not_there_looks_like_none() -> None:
    """A valve that was shut in all training logs: that it sticks can be told from nothing."""
    relations, isolate = STAGES[2], STAGES[-1]
    assert isinstance(relations, Relations)
    assert isinstance(isolate, Isolate)
    valve = Relation(output="air", inputs=("F",), where="leak - 99", nodes=2)
    stuck = Hypothesis(undo={"leak": "theta"}, sizes=(100.0, 110.0), from_zero=False)
    chain = fitted_to(
        (
            Regressors(columns={"air": "ln(W / (p * n))", "fuel": "ln(W / F)"}),
            STAGES[1],
            replace(relations, relations={**relations.relations, "f_valve": valve}),
            Residuals(residuals={"r_air": "air - f_air - f_valve", "r_fuel": "fuel - f_fuel"}),
            replace(isolate, hypotheses={"flow_gain": HYPOTHESES["flow_gain"], "stuck": stuck}),
        )
    )
    fitted = chain[-1]
    assert isinstance(fitted, Isolate)
    assert fitted.points.sizes == [HYPOTHESES["flow_gain"].sizes, ()]
    frame = samples(chain, drive(7, flow=0.05))
    assert frame["p.flow_gain"][-1] > 0.9
    assert (frame["evidence.stuck"] == 0.0).all()
    assert frame["detectable.stuck"].is_null().all()
