"""The recipe for any signals: binding, fitting, alarms, and what a detector keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ingest.errors import RecipeError, StoreError
from ingest.log import Event, Group, Log
from ingest.simulators.examples import simulate_example
from pipeline import diagnose, fit, load_recipe
from pipeline.detector import Detector, check_recipe, load_detector, save_detector
from pipeline.template import bound, filled, with_signals
from stages.narx import Narx


def renamed(log: Log, names: dict[str, str]) -> Log:
    (group,) = log.groups.values()
    return replace(log, groups={group.name: Group(group.name, group.frame.rename(names))})


def example(seed: int, n: int = 1500) -> Log:
    return simulate_example("example1", n=n, seed=seed, name=f"log{seed}")


def drifting(seed: int, n: int = 1500) -> Log:
    """From half the log on the reading of y1 is 0.5 too high, which moves its residual by a fifth of that."""
    log = example(seed, n)
    shift = 0.5 * (pl.int_range(pl.len()) >= n // 2)
    (group,) = log.groups.values()
    group = replace(group, frame=group.frame.with_columns(pl.col("y1") + shift))
    truth = Event(t_start=n / 2, kind="sensor_offset", channel="y1", source="truth")
    return replace(log, groups={group.name: group}, events=(truth,))


@pytest.fixture(scope="module")
def detector() -> Detector:
    return fit([example(801)], load_recipe("narx"), [example(802)])


def test_a_template_is_filled() -> None:
    stages = {"signals": ["{outputs}", "{inputs}", "x"], "first": "f_{y} {u}", "r_{y}": {"of": "{y}"}}
    assert filled(stages, ["a", "b"], ["c"]) == {
        "signals": ["a", "b", "c", "x"], "first": "f_a c", "r_a": {"of": "a"}, "r_b": {"of": "b"},
    }  # fmt: skip
    assert filled(stages, [], []) == {**stages} | {"signals": ["x"]} or filled({"a": "{"}, [], []) == {
        "a": "{"
    }


def test_patterns_are_matched_with_the_logs_signals() -> None:
    recipe = bound(load_recipe("narx"), ["u2", "y1", "u1", "v"])
    assert (recipe.outputs, recipe.inputs) == (("y1",), ("u2", "u1"))
    assert not recipe.template
    assert recipe.signals == ("y1", "u2", "u1")
    with pytest.raises(RecipeError, match=r"no input 'u\*'; known: y1; name them with --input"):
        bound(load_recipe("narx"), ["y1"])
    with pytest.raises(RecipeError, match="are for templates such as narx"):
        with_signals(load_recipe("throttle"), ["y"], [])


def test_healthy_logs_are_quiet_and_a_small_offset_is_found(detector: Detector) -> None:
    for seed in (803, 804):
        assert diagnose(example(seed), detector).verdict.fault == "none"
        verdict = diagnose(drifting(seed), detector).verdict
        assert verdict.fault == "unknown"
        assert verdict.detected_s is not None
        assert 750 <= verdict.detected_s < 1100


def test_residuals_are_as_small_as_the_noise(detector: Detector) -> None:
    samples = diagnose(example(805, 3000), detector).samples
    for residual, noise in (("residual.r_y1", 0.1), ("residual.r_y2", 0.2)):
        assert np.nanstd(samples[residual].cast(pl.Float64).to_numpy()) < 1.05 * noise


def test_the_record_has_the_chosen_regressors(detector: Detector) -> None:
    model = next(s for s in detector.stages if isinstance(s, Narx))
    assert model.inputs("f_y1") == ("y1(t-1)", "y2(t-1)", "u1(t-1)", "u1(t-2)", "u2(t-2)")
    assert detector.record["selected"]["f_y2"] == ["y2(t-1)", "y2(t-2)", "u1(t-1)", "u2(t-1)", "u2(t-2)"]
    left = detector.record["held_out_rms"]["f_y1"]
    assert 0.08 < left["blended"] < left["hard"] < 0.13


def test_a_detector_goes_with_its_template_only(detector: Detector, tmp_path: Path) -> None:
    save_detector(detector, tmp_path)
    loaded = load_detector(tmp_path, detector.key)
    check_recipe(loaded, load_recipe("narx"))
    copy = tmp_path / "narx.toml"
    from pipeline.recipe import recipe_text

    copy.write_text(recipe_text("narx").replace("na_max = 3", "na_max = 2"), encoding="utf-8")
    with pytest.raises(StoreError, match=r"select_inputs\.targets"):
        check_recipe(loaded, load_recipe(copy))


def test_channels_keep_their_own_names() -> None:
    names = {"y1": "Engine torque [Nm]", "y2": "T.out", "u1": "valve %", "u2": "n"}
    recipe = with_signals(load_recipe("narx"), [names["y1"], "T.*"], ["valve*", "n"])
    detector = fit([renamed(example(806, 1200), names)], recipe)
    verdict = diagnose(renamed(example(807, 1200), names), detector).verdict
    assert verdict.fault == "none"
    assert set(verdict.statistics["residuals"]) >= {"r_Engine torque [Nm]", "r_T.out"}
