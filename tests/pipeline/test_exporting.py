"""What is exported says what the run's annotated log says, to our reader and to the formats' own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ingest import read_log
from pipeline import run
from pipeline.batch import Options
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.exporting import FORMATS, export_run
from pipeline.outputs import ANNOTATED


@pytest.fixture(scope="module")
def made(logs: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    run([logs / "faulty.parquet"], detector, out, Options(timeline=False))
    return out / "faulty"


@pytest.mark.parametrize("to", FORMATS)
def test_it_comes_back(made: Path, tmp_path: Path, to: str) -> None:
    path = export_run(made, to, tmp_path / f"x.{to}")
    there, back = read_log(made / ANNOTATED), read_log(path)
    assert {"residuals", "verdict", "regime", "corrected"} <= there.groups.keys()
    assert back.groups.keys() == there.groups.keys()
    assert back.events == there.events
    for name, group in there.groups.items():
        frame = back.groups[name].frame
        assert frame.columns == group.frame.columns
        for column in frame.columns:
            own = group.frame[column]
            exported = frame[column].cast(pl.UInt8) if own.dtype == pl.Boolean else frame[column]
            assert exported.cast(own.dtype).equals(own, null_equal=True), column
            if column != "time":
                assert back.signals[column].unit == there.signals[column].unit


def test_mdf4_opens_in_its_own_library(made: Path, tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(export_run(made, "mf4", tmp_path / "x.mf4")) as file:
        z = file.get("z.r_cyl")
        samples = pl.read_parquet(made / "samples.parquet")
        np.testing.assert_allclose(z.timestamps, samples["time"].to_numpy(), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(z.samples, samples["z.r_cyl"].to_numpy())
        assert file.get("p_Int").unit == "kPa"


def test_the_command(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(made.parent), "--to", "csv", "parquet"]) == 0
    written = [Path(line) for line in capsys.readouterr().out.split()]
    assert written == [made / "annotated.csv", made / "annotated.parquet"]
    assert all(p.is_file() for p in written)
    assert main(["export", str(made), str(tmp_path), "--to", "csv", "--out", str(tmp_path)]) == 1
    told = capsys.readouterr()
    assert told.out.split() == [str(tmp_path / "faulty.csv")]
    assert "holds no annotated.mcap" in told.err
