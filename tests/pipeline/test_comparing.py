from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import StoreError
from ingest.log import Log
from pipeline.comparing import Comparison, compare_detectors
from pipeline.detector import Detector
from pipeline.trial import Injection, attempt, injections, prepare
from stages.isolate import Isolate
from stages.relations import Relations
from stages.stage import ANALYSIS


@pytest.fixture(scope="module")
def held_out(healthy: list[Log]) -> list[Log]:
    """Pieces of a drive, so that there are several logs."""
    log = healthy[1]
    return [replace(log.between(a, a + 130.0), name=f"piece{a}") for a in (0, 130)]


FAULTS = [Injection(fault="maf_gain", size=-0.07), Injection(fault="boost_leak", size=6.0, unit="mm")]


def changed(detector: Detector, kind: type, change: dict[str, float]) -> Detector:
    """A detector whose learned arrays of one stage are multiplied."""
    stages = [
        replace(s, learned={k: v * change[k] if k in change else v for k, v in s.learned.items()})
        if isinstance(s, kind) and isinstance(s, Isolate | Relations)
        else s
        for s in detector.stages
    ]
    return replace(detector, stages=tuple(stages), record={**detector.record, "key": "changed"})


def rows(found: Comparison, what: str, of: str = "") -> list[str]:
    return [r.interval.verdict for r in found.rows if r.what == what and r.of == of and r.interval]


@pytest.fixture(scope="module")
def itself(detector: Detector, held_out: list[Log]) -> Comparison:
    return compare_detectors(detector, detector, held_out, FAULTS)


def test_a_detector_is_neither_better_nor_worse_than_itself(itself: Comparison) -> None:
    assert {r.interval.verdict for r in itself.rows if r.interval} <= {"not worse", "undecided"}
    assert all(r.interval.difference == 0 for r in itself.rows if r.interval)
    assert itself.verdict == "undecided"  # six minutes without an alarm allow many an hour


def test_rows_say_what_was_asked(itself: Comparison, detector: Detector) -> None:
    whats = {r.what for r in itself.rows}
    assert whats >= {"false alarms per h", "detected", "named right", "delay", "log evidence"}
    assert whats >= {"residual sigma", "in domain", "size", "CPU s per h of log"}
    faults = {r.of for r in itself.rows if r.what == "detected" and r.of}
    assert faults == {"maf_gain -0.07", "boost_leak +6 mm"}
    assert any(r.of.startswith("r_cyl in regime") for r in itself.rows)
    assert sum(r.pooled for r in itself.rows) == 6


def test_a_threshold_out_of_reach_is_worse(detector: Detector, held_out: list[Log]) -> None:
    deaf = changed(detector, Isolate, {"threshold": 1e6})
    found = compare_detectors(detector, deaf, held_out, FAULTS)
    assert rows(found, "detected") == ["worse"]
    assert rows(found, "log evidence") == ["worse"]
    assert found.verdict == "worse"
    assert compare_detectors(deaf, detector, held_out, FAULTS).verdict == "better"


@pytest.mark.parametrize(("more", "verdict"), [(1.1, "not worse"), (1.4, "worse")])
def test_a_loss_of_evidence_shows_before_a_fault_is_missed(
    detector: Detector, held_out: list[Log], more: float, verdict: str
) -> None:
    dull = changed(detector, Isolate, {"threshold": more})
    found = compare_detectors(detector, dull, held_out, FAULTS)
    assert rows(found, "log evidence") == [verdict]
    assert rows(found, "detected") == ["undecided"]  # all of them, by both
    assert found.verdict == ("worse" if verdict == "worse" else "undecided")


def test_a_biased_model_leaves_larger_residuals(detector: Detector, held_out: list[Log]) -> None:
    biased = changed(detector, Relations, {"f_Cyl/theta": 1.05})
    found = compare_detectors(detector, biased, held_out, FAULTS)
    assert rows(found, "residual sigma", "r_cyl") == ["worse"]
    assert rows(found, "residual sigma", "r_dp") == ["not worse"]


def test_every_hypothesis_that_can_be_is_injected_at_two_sizes_to_either_side(detector: Detector) -> None:
    found = injections(detector)
    assert [i.size for i in found if i.fault == "maf_gain"] == [0.035, 0.07, -0.035, -0.07]
    assert [(i.size, i.unit) for i in found if i.fault == "boost_leak"] == [(3.0, "mm"), (6.0, "mm")]
    assert not [i for i in found if i.fault.startswith("egr_stuck")]


def test_detectors_of_different_recipes(detector: Detector, held_out: list[Log]) -> None:
    other = replace(detector, recipe=replace(detector.recipe, name="other"))
    with pytest.raises(StoreError, match="compare detectors of one recipe"):
        compare_detectors(detector, other, held_out)


def test_calibration_keeps_the_largest_evidence_of_each_log(detector: Detector) -> None:
    isolate = next(s for s in detector.stages if isinstance(s, Isolate))
    assert isolate.learned["largest"].shape == (1, *isolate.learned["threshold"].shape)
    np.testing.assert_array_equal(
        isolate.thresholds(isolate.learned["largest"]), isolate.learned["threshold"]
    )


def test_samples_that_no_engine_could_give_do_not_count(detector: Detector, healthy: list[Log]) -> None:
    """A residual without a value, as where an injected leak is larger than the flow."""
    prepared = prepare(detector, healthy[1])
    known, _ = attempt(detector, prepared, Injection())
    rows = pl.int_range(pl.len()) % 7 == 0
    holes = prepared.groups[ANALYSIS].frame.with_columns(W_HFM=pl.when(~rows).then("W_HFM"))
    group = replace(prepared.groups[ANALYSIS], frame=holes)
    found, _ = attempt(detector, replace(prepared, groups={ANALYSIS: group}), Injection())
    assert found.named == "none"
    assert found.mass.sum() == pytest.approx(6 / 7 * known.mass.sum(), rel=0.1)
    assert found.largest is not None
    assert np.isfinite(found.largest[:-2]).all()
