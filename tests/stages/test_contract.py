"""What every stage must hold, run over every registered one: a new stage gets these checks by being
registered."""

from __future__ import annotations

import pkgutil
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest

from ingest.log import Group, Log
from stages import STAGES
from stages.align import Align
from stages.compensate import Compensate
from stages.denoise import Denoise
from stages.detect import Detect
from stages.gate import Gate
from stages.hypotheses import Hypothesis
from stages.isolate import Isolate
from stages.monitor import Monitor
from stages.narx import Narx
from stages.normalise import Normalise
from stages.pairs import Pairs
from stages.regressors import Regressors
from stages.relation import Relation
from stages.relations import Relations
from stages.residuals import Residuals
from stages.roughness import Roughness
from stages.select_inputs import SelectInputs, Target
from stages.sensors import Sensors
from stages.signatures import Signatures
from stages.smooth import Smooth
from stages.stage import ANALYSIS, Learner, RowWise, Stage, columns, connected, cut, transform

CHAIN: dict[str, Stage] = {
    "align": Align(signals=("y", "a"), optional=("b", "absent")),
    "roughness": Roughness(signals=("y", "a")),
    "smooth": Smooth(tau_s={"y": 0.3, "a": "0.2 + 0.1 * b"}),
    "regressors": Regressors(columns={"ab": "a * b", "two": "2"}),
    "gate": Gate(rate_per_s={"b": 0.5}),
    "normalise": Normalise(columns=("a", "b")),
    "select_inputs": SelectInputs(targets={"n": Target(output="y", inputs=("a", "b"), fixed=("a",))}),
    "narx": Narx(models={"n": "y"}, regime="n", map=("a", "b")),
    "relations": Relations(
        relations={"f": Relation(output="y", inputs=("a", "b"), nodes=6)}, regime="f", map=("a", "b")
    ),
    "residuals": Residuals(residuals={"r": "y - f", "q": "y / f - 1"}),
    "isolate": Isolate(
        hypotheses={
            "gain": Hypothesis(undo={"y": "y / (1 + theta)"}, sizes=(-0.1, 0.05, 0.1)),
            "offset": Hypothesis(undo={"a": "a - theta"}, sizes=(-0.1, 0.1)),
        },
        offsets={"r": {"1": 0.01, "a": 0.01}},
        memories_s=(5.0, 20.0),
    ),
    "pairs": Pairs(
        also={"sensor_offset": {"a": Hypothesis(undo={"a": "a - theta"}, sizes=(-0.2, -0.1, 0.1, 0.2))}}
    ),
    "sensors": Sensors(signals=("y", "a"), where="b + 1", expected={"y": "f"}, tau_s=2.0, confirm_s=0.5),
    "detect": Detect(memories_s=(5.0, 20.0)),
    "signatures": Signatures(
        table={"high": {"r": "+", "q": "x"}, "low": {"r": "-", "q": "x"}},
        shapes={"high": {"q": "a"}, "low": {"q": "b"}},
    ),
}
MONITORING: dict[str, Stage] = {
    "align": Align(signals=("y", "u")),
    "denoise": Denoise(columns=("u",), samples=500),
    "monitor": Monitor(
        input="u", output="y", rate_hz=100.0, sensor="s", plant="p", plant_order=1, window_s=10.0,
        reference_s=40.0, decimation=5, horizon=8,
        faults={"slow": {"tau_s": "1 + m"}, "weak": {"k_s": "1 + m"}},
    ),
    "compensate": Compensate(
        signal="y", sensor="s", faults={"slow": "time_constant", "weak": "gain"}, max_gap_s=0.05
    ),
}  # fmt: skip
STAGE = {**CHAIN, **{n: s for n, s in MONITORING.items() if n not in CHAIN}}


def test_every_stage_is_checked() -> None:
    assert set(STAGE) == set(STAGES)
    assert all(isinstance(stage, pkgutil.resolve_name(STAGES[name])) for name, stage in STAGE.items())


@pytest.fixture(scope="module")
def both(healthy: Log, healthy_sensor: Log) -> tuple[dict[str, Stage], dict[str, Stage]]:
    """The two chains, fitted."""
    return _fit(CHAIN, healthy), _fit(MONITORING, healthy_sensor)


def _fit(chain: dict[str, Stage], block: Log) -> dict[str, Stage]:
    out: list[Stage] = []
    for stage in chain.values():
        fresh = stage.fit([block], [out]) if isinstance(stage, Learner) else stage
        out = connected([*out, fresh])
        block = transform(out[-1:], block)
    return dict(zip(chain, out, strict=True))


@pytest.fixture
def fitted(
    both: tuple[dict[str, Stage], dict[str, Stage]], request: pytest.FixtureRequest
) -> dict[str, Stage]:
    """The chain of the stage under test."""
    return both[_name(request) not in CHAIN]


@pytest.fixture
def faulty(faulty: Log, slow_sensor: Log, request: pytest.FixtureRequest) -> Log:
    """The log that suits the stage under test."""
    return slow_sensor if _name(request) not in CHAIN else faulty


def _name(request: pytest.FixtureRequest) -> str:
    callspec = getattr(request.node, "callspec", None)
    return str(callspec.params.get("name", "align")) if callspec else "align"


def before(fitted: dict[str, Stage], name: str, log: Log) -> Log:
    return transform([s for n, s in fitted.items() if list(fitted).index(n) < list(fitted).index(name)], log)


def frame_of(log: Log) -> pl.DataFrame:
    return log.groups[ANALYSIS].frame


def assert_same(one: pl.DataFrame, two: pl.DataFrame) -> None:
    """Equal but for the last digits, which the linear algebra's own blocking may change."""
    assert one.schema == two.schema
    for c in one.columns:
        x, y = (frame[c].cast(pl.Float64).fill_null(np.nan).to_numpy() for frame in (one, two))
        np.testing.assert_allclose(
            x, y, rtol=1e-9 if one.schema[c] != pl.Float32 else 1e-5, atol=1e-12, err_msg=c
        )


@pytest.mark.parametrize("name", STAGES)
@pytest.mark.parametrize("block_s", [0.1, 7.3, 100.0])
def test_result_does_not_depend_on_the_block_size(
    name: str, block_s: float, fitted: dict[str, Stage], faulty: Log
) -> None:
    log = before(fitted, name, faulty.between(130.0, 170.0) if block_s < 1 else faulty)
    cut_up, whole = transform([fitted[name]], log, block_s), transform([fitted[name]], log)
    for group in whole.groups:
        assert_same(cut_up.groups[group].frame, whole.groups[group].frame)


def test_the_whole_chain_is_causal(fitted: dict[str, Stage], faulty: Log) -> None:
    """What was said up to a time does not change with what comes after it."""
    whole = frame_of(transform(list(fitted.values()), faulty))
    part = frame_of(transform(list(fitted.values()), faulty.between(0.0, 160.0)))
    known = part.height - 5  # the slow signal's next sample is not there yet
    assert_same(part.head(known), whole.head(known))


@pytest.mark.parametrize("name", STAGES)
def test_input_is_not_changed_and_the_same_comes_out_twice(
    name: str, fitted: dict[str, Stage], faulty: Log
) -> None:
    log = before(fitted, name, faulty)
    copy = {k: g.frame.clone() for k, g in log.groups.items()}
    state = fitted[name].start()
    first = fitted[name].step(state, log)[1]
    second = fitted[name].step(state, log)[1]
    assert first.equals(second)
    assert all(log.groups[k].frame.equals(copy[k]) for k in copy)


@pytest.mark.parametrize("name", STAGES)
def test_gaps_and_missing_values_do_not_crash_or_spread(
    name: str, fitted: dict[str, Stage], faulty: Log
) -> None:
    def holes(g: Group) -> Group:
        names = g.frame.columns[1:]
        missing = pl.col("time").is_between(40, 50)
        frame = g.frame.with_columns(pl.when(missing).then(None).otherwise(pl.col(n)).alias(n) for n in names)
        return replace(g, frame=frame.filter(~pl.col("time").is_between(90, 110)))

    log = replace(faulty, groups={k: holes(g) for k, g in faulty.groups.items()})
    out = frame_of(transform([fitted[name]], before(fitted, name, log)))
    assert out.filter(pl.col("time").is_between(91, 109)).is_empty()
    # a size at the end of its grid has no standard deviation, an optional signal may be absent
    late = out.filter(pl.col("time").is_between(120, 299)).select(
        pl.selectors.float() - pl.selectors.starts_with("size", "detectable", "absent")
    )
    assert late.null_count().sum_horizontal().item() == 0
    assert np.isfinite(late.to_numpy()).all()


@pytest.mark.parametrize("name", STAGES)
def test_column_order_does_not_matter(name: str, fitted: dict[str, Stage], faulty: Log) -> None:
    log = before(fitted, name, faulty)
    turned = replace(
        log,
        groups={
            k: Group(
                k,
                g.frame.select("time", *reversed(g.frame.columns[1:])),
                dict(reversed(list(g.signals.items()))),
            )
            for k, g in log.groups.items()
        },
    )
    one, two = frame_of(transform([fitted[name]], log)), frame_of(transform([fitted[name]], turned))
    assert set(one.columns) == set(two.columns)
    assert_same(one, two.select(one.columns))


@pytest.mark.parametrize("name", STAGES)
def test_settings_and_learned_rebuild_the_stage(name: str, fitted: dict[str, Stage], faulty: Log) -> None:
    stage: Any = fitted[name]
    log = before(fitted, name, faulty)
    again: Any = STAGE[name]
    if isinstance(stage, Learner):
        again = replace(again, learned=dict(stage.learned))
    passed = [s for n, s in fitted.items() if list(fitted).index(n) < list(fitted).index(name)]
    (*_, again) = connected([*passed, again])
    assert frame_of(transform([again], log)).equals(frame_of(transform([stage], log)))


@pytest.mark.parametrize("name", [n for n, s in STAGE.items() if isinstance(s, Learner) and n != "monitor"])
def test_an_unfitted_learner_says_so(name: str, fitted: dict[str, Stage], faulty: Log) -> None:
    log = before(fitted, name, faulty)
    with pytest.raises(ValueError, match="fit it first"):
        transform([STAGE[name]], log)


@pytest.mark.parametrize("name", STAGES)
def test_documented(name: str) -> None:
    cls: Any = pkgutil.resolve_name(STAGES[name])
    assert "Raises:" in cls.__doc__
    assert isinstance(cls.version, str)


def test_cut_covers_every_row_once(faulty: Log) -> None:
    log = faulty
    parts = list(cut(log, 0.7))
    assert sum(p.groups["fast"].frame.height for p in parts) == log.groups["fast"].frame.height
    assert pl.concat([p.groups["slow"].frame for p in parts]).equals(log.groups["slow"].frame)


@pytest.mark.parametrize("name", [n for n, s in CHAIN.items() if isinstance(s, RowWise)])
def test_what_is_wanted_alone_is_the_same(name: str, fitted: dict[str, Stage], faulty: Log) -> None:
    stage = fitted[name]
    assert isinstance(stage, RowWise)
    assert set(stage.sources()) == stage.adds
    values = columns(transform([fitted[n] for n in CHAIN], faulty))
    whole = stage.compute(values)
    for column in stage.adds:
        alone = stage.compute(values, {column})
        np.testing.assert_array_equal(alone[column], whole[column])


@pytest.mark.parametrize("name", STAGES)
def test_says_what_it_needs_and_adds(name: str, fitted: dict[str, Stage], faulty: Log) -> None:
    log = before(fitted, name, faulty)
    out = set(transform([fitted[name]], log).signals)
    had = set(log.signals)
    assert fitted[name].needs <= had
    assert fitted[name].adds - {"absent"} <= out
