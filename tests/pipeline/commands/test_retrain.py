from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ingest.errors import StoreError
from pipeline import trial
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.retraining import promote
from pipeline.store import Store
from pipeline.trial import Injection

NAME = "diesel_airpath"


@pytest.fixture(autouse=True)
def few_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.comparing.injections", lambda _: [Injection(fault="maf_gain", size=-0.07)])
    assert trial.LONGEST_S == 900.0


@pytest.fixture
def own(detector: Detector, tmp_path: Path) -> Store:
    store = Store(tmp_path / "store")
    store.add(detector)
    return store


def call(store: Store, *words: str, status: int = 0) -> None:
    assert main(["retrain", *words, "--recipe", NAME, "--store", str(store.folder)]) == status


def verdict(champion: str, challenger: str, word: str) -> dict[str, Any]:
    row = {"what": "detected", "of": "", "pooled": True, "verdict": word, "difference": -0.1, "low": -0.2,
           "high": -0.05, "unit": ""}  # fmt: skip
    return {"champion": champion, "challenger": challenger, "rows": [row], "verdict": word}


def test_the_challenger_is_kept_compared_and_not_promoted(
    own: Store, logs: Path, detector: Detector, capsys: pytest.CaptureFixture[str]
) -> None:
    call(own, str(logs / "healthy1.parquet"), "--calibrate", str(logs / "healthy2.parquet"), "--json")
    found = json.loads(capsys.readouterr().out)
    (challenger,) = {p.stem for p in own.folder.glob("*.json")} - {detector.key}
    assert (found["champion"], found["challenger"]) == (detector.key, challenger)
    assert found == own.comparison(detector.key, challenger)
    assert own.champion(NAME) == detector.key
    record = own.load(challenger).record
    assert (record["challenges"], record["how"]) == (detector.key, "from scratch")
    (source,) = record["training"]
    assert source["end_s"] == pytest.approx(0.7 * 400, abs=0.1)  # the rest was held out
    assert found["hours"] == pytest.approx(0.3 * 400 / 3600, rel=0.02)
    rows = {(r["what"], r["of"]): r for r in found["rows"]}
    assert rows["detected", ""]["drives"] == 1

    assert main(["detectors", "compare", challenger, "--store", str(own.folder)]) == 0
    said = capsys.readouterr().out
    assert "residual sigma" in said
    assert f"the challenger is {found['verdict']}" in said
    assert main(["detectors", "compare", challenger, "--store", str(own.folder), "--details"]) == 0
    assert "in regime" in capsys.readouterr().out

    page = own.folder.parent / "compared.html"
    words = ["detectors", "compare", challenger, "--store", str(own.folder), "--report"]
    assert main([*words, str(page)]) == 0
    assert f"The challenger is {found['verdict']}" in page.read_text("utf-8")
    assert main([*words, str(page / "below_a_file.html")]) == 2


def test_promotion(own: Store, logs: Path, detector: Detector, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(logs / "healthy1.parquet"), "--holdout", str(logs / "healthy2.parquet")]
    call(own, *words, "--promote", "--reason", "autumn")
    assert own.champion(NAME) != detector.key
    assert own.history(NAME)[-1]["reason"].startswith("autumn (compared: ")
    assert "is champion of diesel_airpath now" in capsys.readouterr().err


def test_what_is_worse_is_refused_unless_forced_with_a_reason(
    own: Store, detector: Detector, second: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    own.keep(second)
    own.keep_comparison(verdict(detector.key, second.key, "worse"))
    with pytest.raises(StoreError, match=r"is worse than the champion .*: detected -0.1 \(-0.2 to -0.05\)"):
        promote(own, second, "")
    assert main(["detectors", "promote", second.key, "--store", str(own.folder)]) == 2
    with pytest.raises(StoreError, match="--force needs a --reason"):
        promote(own, second, "", force=True)
    assert own.champion(NAME) == detector.key
    promote(own, second, "the old sensor is gone", force=True)
    assert own.champion(NAME) == second.key
    assert own.history(NAME)[-1]["reason"] == "the old sensor is gone (compared: worse), forced"


def test_a_refused_promotion_is_exit_1(
    own: Store, logs: Path, detector: Detector, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr("pipeline.comparing._whole", lambda rows: "worse")
    call(own, str(logs / "healthy1.parquet"), "--promote", status=1)
    assert own.champion(NAME) == detector.key
    assert "not promoted" in capsys.readouterr().err
    assert len(own.records()) == 2


def test_without_a_champion(tmp_path: Path, logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call(Store(tmp_path / "empty"), str(logs / "healthy1.parquet"), status=2)
    assert "has no detector of recipe" in capsys.readouterr().err


def test_mistakes_are_told_together(own: Store, logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call(own, str(logs / "none.parquet"), "--force", status=2)
    said = capsys.readouterr().err
    assert "--force goes with --promote and a --reason" in said
    assert "none.parquet" in said


def test_never_compared(own: Store, second: Detector, capsys: pytest.CaptureFixture[str]) -> None:
    own.keep(second)
    assert main(["detectors", "compare", second.key, "--store", str(own.folder)]) == 2
    assert "have not been compared; give fault-free logs" in capsys.readouterr().err
    words = ["detectors", "compare", second.key, "--store", str(own.folder), "--timeline", "both.rrd"]
    assert main(words) == 2
    assert "--timeline both.rrd: there is nothing to draw; name logs with --on" in capsys.readouterr().err
