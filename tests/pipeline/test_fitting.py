from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.errors import LogError
from ingest.log import Group, Log
from pipeline import diagnose, fit
from pipeline.detector import Detector
from pipeline.recipe import Recipe


def without(log: Log, signal: str, rename: str | None = None) -> Log:
    group = log.groups["ecu"]
    frame = group.frame.rename({signal: rename}) if rename else group.frame.drop(signal)
    return replace(log, groups={**log.groups, "ecu": Group("ecu", frame)})


@pytest.fixture(scope="module")
def held_out(healthy: list[Log], recipe: Recipe) -> Detector:
    """Fitted without calibration logs."""
    return fit(healthy[:1], recipe)


def test_without_calibration_logs_it_says_how_weak_that_is(held_out: Detector, detector: Detector) -> None:
    (note,) = held_out.record["notes"]
    assert "--calibrate" in note
    assert held_out.record["calibration"] == []
    assert detector.record["notes"] == []
    assert held_out.key != detector.key


def test_both_are_quiet_on_healthy_drives_and_see_the_fault(
    held_out: Detector, detector: Detector, healthy: list[Log], faulty: Log
) -> None:
    for fitted in (held_out, detector):
        assert [diagnose(log, fitted).verdict.fault for log in healthy] == ["none", "none"]
        verdict = diagnose(faulty, fitted).verdict
        assert verdict.fault == "maf_gain"
        assert verdict.detected_s is not None
        assert 133.0 < verdict.detected_s < 160.0


def test_models_learn_from_training_and_spreads_from_calibration(
    detector: Detector, healthy: list[Log], recipe: Recipe
) -> None:
    other = fit(healthy[:1], recipe, healthy[:1])
    kind = {use.split(".")[1] for use in recipe.versions() if use.split(".")[1] in ("normalise", "relations")}
    same = {k: np.array_equal(v, other.arrays[k]) for k, v in detector.arrays.items()}
    models = {k: v for k, v in same.items() if k.split("/")[0].split(".")[1] in kind}
    assert models
    assert all(models.values())
    assert not all(v for k, v in same.items() if k not in models)


def test_held_out_quarters_were_not_seen(held_out: Detector, healthy: list[Log], recipe: Recipe) -> None:
    """So their residuals spread more than those of samples that the models have seen."""
    seen = fit(healthy[:1], recipe, healthy[:1])
    one, two = (diagnose(healthy[0], d).samples for d in (held_out, seen))
    sigmas = [c for c in one.columns if c.startswith("sigma.")]
    wider = [np.nanmedian((one[c] / two[c]).to_numpy()) for c in sigmas]
    assert np.mean(wider) > 1.02


def test_fitting_twice_learns_the_same_to_the_bit(
    held_out: Detector, healthy: list[Log], recipe: Recipe
) -> None:
    assert fit(healthy[:1], recipe).record["arrays_sha256"] == held_out.record["arrays_sha256"]


def test_progress_tells_each_step(healthy: list[Log], recipe: Recipe) -> None:
    said: list[str] = []
    fit(healthy[:1], recipe, healthy[1:], progress=said.append)
    assert said[0].startswith("preparing 2 log(s): align")
    assert "fitting on 800 samples" in said
    assert said[-1] == "setting spreads and thresholds on 800 samples"


def test_no_logs(recipe: Recipe) -> None:
    with pytest.raises(LogError, match="at least one fault-free log"):
        fit([], recipe)


@pytest.mark.parametrize("seconds", [0.5, 2.0, 15.0, 40.0])
def test_too_short_a_log_is_a_clear_error(healthy: list[Log], recipe: Recipe, seconds: float) -> None:
    with pytest.raises(LogError, match=r"^healthy1: \d+ s of usable samples .* are too few"):
        fit([healthy[0].between(100.0, 100.0 + seconds)], recipe)


def test_log_without_rows(healthy: list[Log], recipe: Recipe) -> None:
    empty = healthy[0].between(-2.0, -1.0)
    with pytest.raises(LogError, match=r"^healthy1: 0 s of usable samples"):
        fit([empty], recipe)


def test_missing_signal_is_named_with_near_ones(healthy: list[Log], recipe: Recipe) -> None:
    log = without(healthy[0], "p_Bst", rename="p_Boost")
    with pytest.raises(LogError, match="'healthy1' has no signal 'p_Bst'; did you mean p_Boost"):
        fit([log], recipe)
    with pytest.raises(LogError, match="'healthy1' has no signal 'p_Bst'"):
        fit(healthy[1:], recipe, [log])


def test_signal_that_is_missing_throughout(healthy: list[Log], recipe: Recipe) -> None:
    group = healthy[0].groups["ecu"]
    frame = group.frame.with_columns(p_Bst=pl.lit(None, dtype=pl.Float64))
    log = replace(healthy[0], groups={"ecu": Group("ecu", frame, group.signals)})
    with pytest.raises(LogError, match=r"'?p_Bst'?"):
        fit([log], recipe)


def test_signal_that_is_text(healthy: list[Log], recipe: Recipe) -> None:
    group = healthy[0].groups["ecu"]
    frame = group.frame.with_columns(p_Bst=pl.lit("high"))
    log = replace(healthy[0], groups={"ecu": Group("ecu", frame, group.signals)})
    with pytest.raises(LogError, match="signal 'p_Bst' holds String, not numbers"):
        fit([log], recipe)
