from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from ingest.errors import LogError
from pipeline import run
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.reporting import write_report
from pipeline.runs import is_run, read_run, run_folders
from pipeline.summary import SUMMARY_SCHEMA
from stages.results import Diagnosis
from viz.report import sections


@pytest.fixture(scope="module")
def out(logs: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from pipeline.batch import Options

    folder = tmp_path_factory.mktemp("batch") / "out"
    paths = [logs / "healthy2.parquet", logs / "faulty.parquet"]
    bad = folder.parent / "bad.csv"
    bad.write_text("time,x\n0,1\n")
    run([*paths, bad], detector, folder, Options(timeline=False))
    return folder


def test_a_run_is_read_back_as_it_was(out: Path, logs: Path, detector: Detector) -> None:
    from ingest import read_log

    made = diagnose(read_log(logs / "faulty.parquet"), detector)
    back = read_run(out / "faulty")
    assert back.samples.equals(made.samples)
    assert back.units == made.units
    assert back.verdict.fault == made.verdict.fault == "maf_gain"
    assert back.verdict.events == made.verdict.events
    assert back.verdict.magnitude == made.verdict.magnitude
    for name, group in made.log.groups.items():
        assert back.log.groups[name].frame.equals(group.frame)
    assert [e for e in back.log.events if e.source == "truth"] == [
        e for e in made.log.events if e.source == "truth"
    ]
    assert made.operating_map is not None
    assert back.operating_map is not None
    for part in ("nodes", "edges", "visits", "spread"):
        assert (getattr(back.operating_map, part) == getattr(made.operating_map, part)).all()
    assert back.signals is not None
    assert made.signals is not None
    assert back.signals.frame.equals(made.signals.frame)
    assert [f.name for f in run_folders(out)] == ["faulty", "healthy2"]


def test_without_values_the_log_has_no_rows(out: Path) -> None:
    log = read_run(out / "faulty", values=False).log
    assert "p_Int" in log.signals
    assert all(g.frame.height == 0 for g in log.groups.values())


def test_a_damaged_run_is_named(out: Path, tmp_path: Path) -> None:
    import shutil

    copy = shutil.copytree(out / "faulty", tmp_path / "faulty")
    (copy / "samples.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(LogError, match=r"faulty: damaged.*run its log again"):
        read_run(copy)
    (copy / "manifest.json").unlink()
    assert not is_run(copy)
    with pytest.raises(LogError, match="not a run's folder"):
        read_run(copy)


def test_the_report_holds_every_log_and_is_drawn_once(out: Path) -> None:
    drawn: list[str] = []
    path = write_report(out, progress=drawn.append)
    text = path.read_text("utf-8")
    assert [s.log for s in sections(text)] == ["healthy2", "faulty"]
    assert "bad" in text
    assert text.count('<tr data-fault="') == 3
    before = path.read_bytes()
    assert write_report(out).read_bytes() == before
    marked = text.replace("<section class", "<section data-marked class")
    path.write_text(marked, "utf-8")
    assert "data-marked" in write_report(out).read_text("utf-8")
    for manifest in out.glob("*/manifest.json"):  # of another run: drawn anew
        manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "key": "other"}))
    assert "data-marked" not in write_report(out).read_text("utf-8")


def test_the_faulty_ones_are_drawn_first(out: Path) -> None:
    text = write_report(out, drawn=1).read_text("utf-8")
    assert [s.log for s in sections(text)] == ["faulty"]
    assert "1 of 2 logs are drawn" in text


def test_the_command_says_where_and_what_is_wrong(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(out / "faulty")]) == 0
    assert capsys.readouterr().out.strip() == str(out / "faulty" / "report.html")
    (out / "faulty" / "report.html").unlink()
    assert main(["report", str(tmp_path)]) == 2
    assert "not the folder of a batch" in capsys.readouterr().err
    assert main(["report", str(out), "--drawn", "-1"]) == 2


def test_a_failed_log_only(tmp_path: Path) -> None:
    frame = pl.DataFrame({c: [None] for c in SUMMARY_SCHEMA}, schema=SUMMARY_SCHEMA)
    frame.with_columns(log=pl.lit("x"), status=pl.lit("failed"), reason=pl.lit("gone")).write_parquet(
        tmp_path / "summary.parquet"
    )
    assert "gone" in write_report(tmp_path).read_text("utf-8")


def test_a_log_without_its_rows_is_drawn(out: Path) -> None:
    from viz.report import section

    drawn = section(read_run(out / "faulty", values=False), "key")
    assert drawn.html.count("<svg") == 2
    assert drawn.signature == section(read_run(out / "faulty"), "key").signature


def test_a_log_that_cannot_be_drawn_is_named_and_costs_the_others_nothing(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import viz.report

    real = viz.report.section

    def section(diagnosis: Diagnosis, key: str) -> viz.report.Section:
        if diagnosis.log.name == "faulty":
            raise IndexError("of matplotlib's")
        return real(diagnosis, key)

    monkeypatch.setattr(viz.report, "section", section)
    (out / "report.html").unlink(missing_ok=True)
    text = write_report(out).read_text("utf-8")
    assert "faulty is not drawn: IndexError: of matplotlib" in text
    assert [s.log for s in sections(text)] == ["healthy2"]
