from __future__ import annotations

import argparse
from pathlib import Path

import polars as pl
import pytest

from ingest import write_log
from ingest.errors import LogError
from ingest.log import Group, Log
from pipeline.commands import view
from pipeline.viewing import to_show
from viz.timeline import write_log_timeline


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    view.add_arguments(parser)
    return parser.parse_args(words)


@pytest.fixture
def log() -> Log:
    return Log(
        name="drive", groups={"g": Group("g", pl.DataFrame({"time": [0.0, 1.0], "p_Int": [100.0, 101.0]}))}
    )


def test_runs_recordings_and_logs_become_one_file(
    log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(log, tmp_path / "drive.parquet")
    (tmp_path / "out" / "run").mkdir(parents=True)
    write_log_timeline(log, tmp_path / "out" / "run" / "timeline.rrd")
    save = tmp_path / "all.rrd"
    words = (str(tmp_path / "out"), str(tmp_path / "drive.parquet"), "--save", str(save))
    assert view.run(parsed(*words)) == 0
    assert save.stat().st_size > 1000
    captured = capsys.readouterr()
    assert captured.out == ""
    assert str(save) in captured.err


def test_logs_are_read_and_recordings_left_as_files(log: Log, tmp_path: Path) -> None:
    write_log(log, tmp_path / "drive.parquet")
    write_log_timeline(log, tmp_path / "drive.rrd")
    found = to_show([str(tmp_path / "drive.rrd"), str(tmp_path / "drive.parquet")], None, tmp_path)
    assert found[0] == tmp_path / "drive.rrd"
    assert isinstance(found[1], Log)
    assert found[1].values("p_Int").tolist() == [100.0, 101.0]


def test_what_is_neither_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="nowhere"):
        to_show([str(tmp_path / "nowhere")], None, tmp_path)
