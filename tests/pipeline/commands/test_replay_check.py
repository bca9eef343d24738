"""The stored set of logs gives what it gave; a difference is told with its stage and its first row."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from ingest.errors import LogError
from pipeline import fit, regression
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.regression import SET, check, update
from stages.relations import Relations

HOME = Path(__file__).resolve().parents[3] / "data" / "replay"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of one log, to be damaged."""
    folder = tmp_path_factory.mktemp("set") / "one"
    shutil.copytree(HOME / "diesel_airpath", folder)
    shutil.rmtree(folder / "expected", ignore_errors=True)
    text = 'recipe = "diesel_airpath"\ntraining = ["training.parquet"]\n'
    text += 'calibration = ["calibration.parquet"]\nlogs = ["maf_low.parquet"]\n'
    (folder / SET).write_text(text)
    assert update(folder) == ["maf_low"]
    return folder


@pytest.fixture
def own(small: Path, tmp_path: Path) -> Path:
    shutil.copytree(small, tmp_path / "own")
    return tmp_path / "own"


@pytest.mark.parametrize("folder", sorted(p.parent for p in HOME.glob(f"*/{SET}")), ids=lambda p: str(p.name))
def test_the_stored_sets_give_what_they_gave(folder: Path) -> None:
    """If a change of the outputs is meant: `dynoscope replay-check --update`, and look at the diff."""
    assert [str(d) for d in check(folder)] == []


def test_nothing_differs_from_itself(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay-check", str(own)]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "no difference(s)" in err


def test_a_changed_row_is_told(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = own / "expected" / "maf_low.parquet"
    frame = pl.read_parquet(path)
    rows = [10, 50]
    wrong = frame["W_HFM"].to_list()
    for row in rows:
        wrong[row] *= 1.01
    frame.with_columns(W_HFM=pl.Series(wrong, dtype=pl.Float32)).write_parquet(path)
    assert main(["replay-check", str(own)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1, lines
    (line,) = lines
    first = f"first at {frame['time'][10]:g} s"
    assert re.match(rf"maf_low: align: W_HFM: 2 difference\(s\), {first}: [\d.]+ -> [\d.]+$", line)


def test_a_changed_verdict_is_told(own: Path) -> None:
    path = own / "expected" / "maf_low.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "fault": "boost_leak"}))
    (found,) = check(own)
    assert str(found) == "maf_low: verdict: fault: boost_leak -> maf_gain"


def test_differences_begin_at_the_stage_that_changed(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = fit

    def other(*args: object, **more: object) -> Detector:
        detector = real(*args, **more)  # type: ignore[arg-type]
        stages = [
            replace(s, learned={**s.learned, "f_dp/theta": 1.01 * s.learned["f_dp/theta"]})
            if isinstance(s, Relations)
            else s
            for s in detector.stages
        ]
        return replace(detector, stages=tuple(stages))

    monkeypatch.setattr(regression, "fit", other)
    found = check(own)
    assert (found[0].stage, found[0].signal) == ("relations", "f_dp")
    assert {d.stage for d in found} <= {"relations", "residuals", "isolate", "pairs", "sensors", "verdict"}
    assert "residual.r_cyl" not in {d.signal for d in found}


def test_what_is_missing(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (own / "expected" / "maf_low.json").unlink()
    with pytest.raises(LogError, match=r"expected output of maf_low cannot be read.*--update"):
        check(own)
    (own / SET).unlink()
    assert main(["replay-check", str(own)]) == 2
    assert "set.toml cannot be read" in capsys.readouterr().err
