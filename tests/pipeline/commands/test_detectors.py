from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ingest.log import Log
from pipeline import fit
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.recipe import Recipe, build_recipe
from pipeline.store import Store

NAME = "diesel_airpath"


@pytest.fixture
def two(detector: Detector, second: Detector, tmp_path: Path) -> Store:
    store = Store(tmp_path / "store")
    store.add(detector)
    store.add(second)
    return store


def called(capsys: pytest.CaptureFixture[str], store: Path, *words: str, status: int = 0) -> Any:
    assert main(["detectors", *words, "--store", str(store), "--json"]) == status
    out, err = capsys.readouterr()
    return json.loads(out) if out else err


def test_list(two: Store, detector: Detector, second: Detector, capsys: pytest.CaptureFixture[str]) -> None:
    entries = called(capsys, two.folder, "list")
    assert {e["key"]: e["champion"] for e in entries} == {detector.key: True, second.key: False}
    assert {e["recipe"] for e in entries} == {NAME}
    assert all(e["created"] and e["problem"] is None for e in entries)
    assert main(["detectors", "list", "--store", str(two.folder)]) == 0
    assert "champion" in capsys.readouterr().out


def test_a_damaged_detector_is_listed_with_what_is_wrong(
    two: Store, second: Detector, capsys: pytest.CaptureFixture[str]
) -> None:
    path = two.folder / f"{second.key}.npz"
    path.write_bytes(path.read_bytes()[:-10])
    problems = {e["key"]: e["problem"] for e in called(capsys, two.folder, "list", status=1)}
    assert "cannot be read" in problems.pop(second.key)
    assert list(problems.values()) == [None]


def test_an_old_format_is_refused_clearly(
    two: Store, second: Detector, capsys: pytest.CaptureFixture[str]
) -> None:
    path = two.folder / f"{second.key}.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format": 0}))
    said = called(capsys, two.folder, "show", second.key, status=2)
    assert "has format 0, this version of dynoscope reads 2; fit the detector again on again" in said


def test_promote_and_roll_back(
    two: Store, detector: Detector, second: Detector, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(capsys, two.folder, "promote", second.key[:12], "--reason", "fewer alarms") == [second.key]
    (shown,) = called(capsys, two.folder, "show", "champion")
    assert (shown["key"], shown["champion"]) == (second.key, True)
    assert [e["reason"] for e in shown["history"]] == ["fewer alarms"]
    assert called(capsys, two.folder, "rollback") == [detector.key]
    assert two.champion(NAME) == detector.key
    said = called(capsys, two.folder, "rollback", status=2)
    assert "has had no champion before this one" in said
    assert [e["key"] for e in two.history(NAME)] == [detector.key, second.key, detector.key]


def test_a_damaged_detector_is_not_promoted(
    two: Store, detector: Detector, second: Detector, capsys: pytest.CaptureFixture[str]
) -> None:
    (two.folder / f"{second.key}.npz").unlink()
    assert "cannot be read" in called(capsys, two.folder, "promote", second.key, status=2)
    assert two.champion(NAME) == detector.key


def test_rolling_back_twice_goes_back_twice(two: Store, detector: Detector, second: Detector) -> None:
    for key in (second.key, detector.key, second.key):
        two.promote(key, NAME, "x")
    assert [two.rollback(NAME, "x") for _ in range(3)] == [detector.key, second.key, detector.key]


def test_export_and_import(
    two: Store, detector: Detector, second: Detector, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away, other = tmp_path / "away", tmp_path / "other"
    assert called(capsys, two.folder, "export", second.key, "--to", str(away)) == [second.key]
    assert sorted("".join(p.suffixes) for p in away.iterdir()) == [".json", ".npz", ".sums.npz"]
    assert called(capsys, other, "import", str(away)) == [second.key]
    assert Store(other).get(NAME).key == second.key  # the first of its recipe there
    assert sorted(called(capsys, other, "import", str(two.folder))) == sorted([detector.key, second.key])
    assert Store(other).champion(NAME) == second.key
    damaged = other / f"{detector.key}.npz"
    damaged.write_bytes(bytes(100))
    empty = tmp_path / "empty"
    assert "cannot be read" in called(capsys, empty, "import", str(other), status=2)
    assert not empty.exists()  # all or none
    assert "is not a detector" in called(capsys, empty, "import", str(tmp_path / "x.txt"), status=2)


def test_many_writers_lose_nothing(two: Store, detector: Detector, second: Detector) -> None:
    code = (
        "import sys; from pathlib import Path; from pipeline.store import Store\n"
        "store = Store(Path(sys.argv[1]))\n"
        "for i in range(25): store.promote(sys.argv[2], sys.argv[3], f'{i}')\n"
    )
    writers = [
        subprocess.Popen([sys.executable, "-c", code, two.folder, key, NAME])
        for key in (detector.key, second.key, detector.key)
    ]
    assert [w.wait() for w in writers] == [0, 0, 0]
    history = two.history(NAME)
    assert len(history) == 1 + 75
    assert sorted(e["reason"] for e in history[1:]) == sorted([f"{i}" for i in range(25)] * 3)


def test_what_is_wrong_is_said(two: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no such folder" in called(capsys, tmp_path / "nowhere", "list", status=2)
    assert "has no detector 'zzz'" in called(capsys, two.folder, "show", "zzz", status=2)
    shutil.rmtree(two.folder)
    two.folder.mkdir()
    assert "name one with --recipe" in called(capsys, two.folder, "rollback", status=2)


def test_the_study_of_map_sizes_as_a_plot(
    healthy: list[Log], recipe: Recipe, two: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    definition = recipe.to_json()
    stage = next(s for s in definition["stage"] if s["use"] == "relations")
    stage["relations"]["f_Cyl"]["sizes"] = [1, 8]
    detector = fit(healthy[:1], build_recipe(recipe.name, definition), healthy[1:])
    assert detector.record["scores"]["map_nodes"]["f_Cyl"] in (1.0, 8.0)
    two.keep(detector)
    picture = tmp_path / "study.png"
    called(capsys, two.folder, "show", detector.key, "--plot", str(picture))
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["detectors", "show", detector.key, "--plot", "x.gif", "--store", str(two.folder)]) == 2
    assert "expected a .png or .svg file" in capsys.readouterr().err
    plain = next(k for k in (e["key"] for e in two.survey()) if k != detector.key)
    said = called(capsys, two.folder, "show", plain, "--plot", str(picture), status=2)
    assert "fitted without a study of map sizes" in said
