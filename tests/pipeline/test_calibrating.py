from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ingest.errors import LogError, RecipeError
from ingest.log import Log
from pipeline import diagnose
from pipeline.calibrating import LEAST, calibrate
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.store import Store
from stages import alarm_rate
from stages.isolate import Isolate

NAME = "diesel_airpath"


def threshold(detector: Detector) -> np.ndarray:
    return next(s.learned["threshold"] for s in detector.stages if isinstance(s, Isolate))


@pytest.fixture
def short_spans(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the short drives of these tests have enough of them."""
    monkeypatch.setattr(alarm_rate, "SPAN_S", 60.0)


def test_models_stay_and_thresholds_are_those_of_the_logs(detector: Detector, healthy: list[Log]) -> None:
    new = calibrate(detector, healthy)
    models = {k for k in detector.arrays if ".relations/" in k or ".normalise/" in k}
    assert models
    assert all(np.array_equal(detector.arrays[k], new.arrays[k]) for k in models)
    assert new.record["calibrated_from"] == detector.key
    assert new.record["training"] == detector.record["training"]
    assert [s["log"] for s in new.record["calibration"]] == ["healthy1", "healthy2"]
    assert calibrate(detector, healthy[1:]).record["arrays_sha256"] == detector.record["arrays_sha256"]


def test_fewer_false_alarms_take_higher_thresholds_and_see_less(
    detector: Detector, healthy: list[Log], faulty: Log, short_spans: None
) -> None:
    many, few = (calibrate(detector, healthy, rate) for rate in (20.0, 1e-6))
    assert (threshold(many) <= threshold(few)).all()
    assert threshold(many).min() >= LEAST
    assert many.record["false_alarms"]["per_h"] == 20.0
    assert many.record["false_alarms"]["calibration_h"] == pytest.approx(800 / 3600, rel=0.01)
    assert "extrapolated" in few.record["notes"][0]
    delays = [diagnose(faulty, d).verdict.detected_s or np.inf for d in (many, few)]
    assert delays[0] < delays[1]


def test_what_cannot_be_done(detector: Detector, healthy: list[Log]) -> None:
    with pytest.raises(LogError, match="nothing to calibrate on"):
        calibrate(detector, [])
    with pytest.raises(LogError, match=r"cannot be set from 0.22 h"):
        calibrate(detector, healthy, 1.0)
    with pytest.raises(RecipeError, match="above 0"):
        calibrate(detector, healthy, 0.0)
    stages = [s for s in detector.stages if not isinstance(s, Isolate)]
    with pytest.raises(RecipeError, match="has no stage `isolate`"):
        calibrate(replace(detector, stages=tuple(stages)), healthy, 1.0)


def test_by_command(
    store: Store, detector: Detector, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = Store(tmp_path / "store")
    own.add(detector)
    words = ["fit", "--recipe", NAME, "--store", str(own.folder), "--from", "champion"]
    assert main([*words, "--calibrate", str(logs / "healthy1.parquet")]) == 0
    key = capsys.readouterr().out.strip()
    assert own.load(key).record["calibrated_from"] == detector.key
    assert own.champion(NAME) == detector.key  # it does not promote itself


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--from", "champion"], "--from needs fault-free logs"),
        (["x.csv", "--from", "champion", "--calibrate", "y"], "--from keeps the models of a detector"),
        ([], "no LOG to fit on"),
        (["x.csv", "--false-alarms", "1"], "--false-alarms goes with --from"),
        (
            ["--from", "champion", "--calibrate", "y", "--false-alarms", "-1"],
            "expected alarms per hour, above 0",
        ),
        (["--from", "zzz", "--calibrate", "y"], "no such|there is no|zzz"),
    ],
)
def test_options_that_make_no_sense(
    store: Store, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import re

    assert main(["fit", *words, "--recipe", NAME, "--store", str(store.folder)]) == 2
    assert re.search(said, capsys.readouterr().err)
