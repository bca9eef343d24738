from __future__ import annotations

import hashlib
import json
import shutil
from itertools import pairwise
from pathlib import Path

import pytest

from ingest.errors import LogError, StoreError
from ingest.log import Log
from pipeline import run
from pipeline.batch import Options
from pipeline.cli import main
from pipeline.commands.explain import lines
from pipeline.detector import Detector, new_detector, save_detector
from pipeline.lineage import explain
from pipeline.store import Store


@pytest.fixture
def out(logs: Path, detector: Detector, tmp_path: Path) -> Path:
    shutil.copy(logs / "faulty.parquet", tmp_path / "drive.parquet")
    run([tmp_path / "drive.parquet"], detector, tmp_path / "out", Options(timeline=False))
    return tmp_path / "out"


def test_a_number_is_walked_back_to_its_log(out: Path, detector: Detector) -> None:
    found = explain(out / "drive" / "samples.parquet")
    content = (out / "drive" / "samples.parquet").read_bytes()
    assert found["sha256"] == hashlib.sha256(content).hexdigest()
    links = [(step["input"], step["output"]) for step in found["steps"]]
    assert all(a[0] == b[1] for a, b in pairwise(links))  # an unbroken chain ...
    assert links[-1][0] == found["log"]["sha256"]  # ... that ends at the log
    (adds,) = [step["adds"] for step in found["steps"] if "residual.r_cyl" in step.get("adds", ())]
    assert "z.r_dp" in adds
    assert found["detector"]["key"] == detector.key
    assert [t["log"] for t in found["detector"]["training"]] == ["healthy1"]
    assert found["log"]["now"] == "unchanged"


def test_what_became_of_the_log_is_said(out: Path, logs: Path) -> None:
    log = out.parent / "drive.parquet"
    shutil.copy(logs / "healthy1.parquet", log)
    assert explain(out / "drive")["log"]["now"] == "changed since"
    log.unlink()
    assert explain(out / "drive")["log"]["now"] == "not there any more"


def test_summaries_and_detectors(out: Path, store: Store, detector: Detector) -> None:
    for path in (out, out / "summary.parquet", out / "summary.csv"):
        assert [r["log"] for r in explain(path)["runs"]] == ["drive"]
    assert explain(out / "fleet.csv")["what"] == "counted from summary.parquet"
    for suffix in (".npz", ".json"):
        found = explain(store.folder / f"{detector.key}{suffix}")
        assert (found["key"], found["recipe"]) == (detector.key, "diesel_airpath")


def test_what_nothing_is_known_of(out: Path, tmp_path: Path) -> None:
    (tmp_path / "x.txt").touch()
    (out / "drive" / "mine.txt").touch()
    (out / "drive" / "manifest.json").write_text("{}")
    for path, words in (
        (tmp_path / "x.txt", "nothing is known of it"),
        (tmp_path / "y", "there is no such file"),
        (out / "drive" / "mine.txt", "was not written by a run"),
        (out / "drive" / "verdict.json", "manifest.json cannot be read"),
    ):
        with pytest.raises(LogError, match=words):
            explain(path)


def test_a_changed_detector_is_not_explained(store: Store, detector: Detector, tmp_path: Path) -> None:
    record = json.loads((store.folder / f"{detector.key}.json").read_text())
    (tmp_path / f"{detector.key}.json").write_text(json.dumps({**record, "training": []}))
    with pytest.raises(StoreError, match="was changed"):
        explain(tmp_path / f"{detector.key}.json")


def test_command(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", str(out / "drive" / "verdict.json")]) == 0
    said = capsys.readouterr().out
    for words in ("<- isolate version", "<- align version", "<- log ", "<- training healthy1", "unchanged"):
        assert words in said
    assert main(["explain", str(out / "drive"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["log"]["now"] == "unchanged"
    assert main(["explain", str(out / "nothing")]) == 2


def test_where_a_challenger_comes_from(detector: Detector, healthy: list[Log], tmp_path: Path) -> None:
    origin = {"challenges": "abc", "how": "from scratch"}
    challenger = new_detector(detector.recipe, detector.stages, healthy[:1], healthy[1:], [], origin)
    save_detector(challenger, tmp_path)
    said = "\n".join(lines(explain(tmp_path / f"{challenger.key}.json")))
    assert "challenges abc, from scratch" in said
    rate = {"calibrated_from": "xyz", "false_alarms": {"per_h": 0.5}}
    calibrated = new_detector(detector.recipe, detector.stages, healthy[:1], healthy[1:], [], rate)
    save_detector(calibrated, tmp_path)
    said = "\n".join(lines(explain(tmp_path / f"{calibrated.key}.json")))
    assert "models of xyz, calibrated anew, for 0.5 false alarms per hour" in said
