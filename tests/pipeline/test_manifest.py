from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from pipeline import run
from pipeline.batch import Options
from pipeline.detector import Detector
from pipeline.digest import file_sha256
from pipeline.manifest import packages, run_key
from pipeline.recipe import Recipe


@pytest.fixture(scope="module")
def manifest(logs: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("out")
    run([logs / "faulty.parquet"], detector, out, Options(timeline=False))
    return dict(json.loads((out / "faulty" / "manifest.json").read_text()))


def test_lineage_leads_from_the_file_through_every_stage(
    manifest: dict[str, Any], logs: Path, recipe: Recipe
) -> None:
    steps = manifest["steps"]
    assert [s["stage"] for s in steps] == list(recipe.uses)
    inputs, outputs = [s["input"] for s in steps], [s["output"] for s in steps]
    assert inputs == [file_sha256(logs / "faulty.parquet"), *outputs[:-1]]
    assert len(set(outputs)) == len(outputs)
    assert [{"use": s["stage"], **s["settings"]} for s in steps] == recipe.to_json()["stage"]
    assert {f"{i}.{s['stage']}": s["version"] for i, s in enumerate(steps)} == recipe.versions()


def test_says_what_was_read_with_what_and_when(
    manifest: dict[str, Any], logs: Path, detector: Detector
) -> None:
    assert manifest["log"]["sha256"] == file_sha256(logs / "faulty.parquet")
    assert manifest["log"]["path"] == str(logs / "faulty.parquet")
    assert manifest["detector"]["key"] == detector.key
    assert manifest["detector"]["training"] == detector.record["training"]
    assert manifest["packages"] == packages()
    assert manifest["packages"]["numpy"] == version("numpy")
    assert set(manifest["times"]) == {"started", "seconds"}


def test_run_key_depends_on_log_detector_and_options(manifest: dict[str, Any], detector: Detector) -> None:
    sha256 = manifest["log"]["sha256"]
    assert manifest["key"] == run_key(sha256, detector, {"map": None})
    other = Detector(recipe=detector.recipe, stages=detector.stages, record={**detector.record, "key": "x"})
    keys = {manifest["key"], run_key("0", detector, {"map": None}), run_key(sha256, detector, {"map": "m"})}
    assert len({*keys, run_key(sha256, other, {"map": None})}) == 4
