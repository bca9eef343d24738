"""What ``dynoscope view`` makes of runs, batches, annotated logs, and several of them."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from recordings import frames, series
from rerun.chunk import RrdReader

from ingest import read_log
from ingest.errors import LogError
from pipeline import run
from pipeline.batch import Options
from pipeline.detector import Detector
from pipeline.runs import read_run
from pipeline.viewing import layers, to_show, write_compared
from stages.results import Diagnosis
from viz.beside import write_beside, write_comparison
from viz.viewer import executable


def texts(path: Path) -> dict[str, str]:
    """Every document of a recording."""
    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if "TextDocument:text" in batch.schema.names:
            found[str(chunk.entity_path)] = str(batch["TextDocument:text"].to_pylist()[-1][0])
    return found


def entities(path: Path) -> set[str]:
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()}


def sound(path: Path) -> bool:
    done = subprocess.run([str(executable()), "rrd", "verify", str(path)], capture_output=True, check=False)
    return done.returncode == 0


@pytest.fixture(scope="module")
def out(logs: Path, detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("batch")
    run([logs / "healthy2.parquet", logs / "faulty.parquet"], detector, folder, Options(timeline=False))
    return folder


@pytest.fixture(scope="module")
def other(logs: Path, second: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The faulty log, diagnosed by another detector."""
    folder = tmp_path_factory.mktemp("other")
    run([logs / "faulty.parquet"], second, folder, Options(timeline=False))
    return folder / "faulty"


def test_a_batch_is_an_overview_and_its_runs(out: Path, tmp_path: Path) -> None:
    overview, first, last = to_show([str(out)], None, tmp_path)
    assert isinstance(overview, Path)
    assert isinstance(first, Diagnosis)
    assert isinstance(last, Diagnosis)
    assert [first.log.name, last.log.name] == ["faulty", "healthy2"]
    assert sound(overview)
    assert {"/faulty", "/healthy2"} <= entities(overview)
    words = texts(overview)["/summary"]
    assert "2 logs · 1 with a fault · 1 fault-free" in words
    assert "| faulty | Air mass flow sensor reads wrong |" in words


def test_of_many_logs_those_with_a_fault_come_first(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.viewing.OPENED", 1)
    monkeypatch.setattr("pipeline.viewing.LANES", 1)
    overview, *opened = to_show([str(out)], None, tmp_path)
    assert isinstance(overview, Path)
    assert [one.log.name for one in opened if isinstance(one, Diagnosis)] == ["faulty"]
    assert "/faulty" in entities(overview)
    assert "/healthy2" not in entities(overview)
    assert "1 are there, those with a fault first" in texts(overview)["/summary"]
    assert "| healthy2 |" in texts(overview)["/summary"]


def test_a_run_without_a_recording_is_made_one(out: Path, tmp_path: Path) -> None:
    (found,) = to_show([str(out / "faulty")], None, tmp_path)
    assert isinstance(found, Diagnosis)
    assert found.operating_map is not None
    assert found.about is not None


def test_of_a_log_in_parts_the_recording_must_be_there(out: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(out / "faulty", tmp_path / "faulty")
    manifest = json.loads((copy / "manifest.json").read_text())
    (copy / "manifest.json").write_text(json.dumps({**manifest, "in_parts": True}))
    with pytest.raises(LogError, match=r"too large.*without --no-timeline"):
        to_show([str(copy)], None, tmp_path)


def test_an_annotated_log_is_shown_with_what_was_found(out: Path, tmp_path: Path) -> None:
    (found,) = to_show([str(out / "faulty" / "annotated.mcap")], None, tmp_path)
    assert isinstance(found, Diagnosis)
    assert found.verdict.fault == "maf_gain"
    samples, there = found.samples, pl.read_parquet(out / "faulty" / "samples.parquet")
    assert set(there.columns) == set(samples.columns)
    assert samples["z.r_cyl"].equals(there["z.r_cyl"])
    assert samples["p.maf_gain"].equals(there["p.maf_gain"])
    assert found.verdict.detected_s == read_run(out / "faulty").verdict.detected_s


def test_two_runs_of_one_log_are_compared(out: Path, other: Path, tmp_path: Path) -> None:
    together, first, second = to_show([str(out / "faulty"), str(other)], None, tmp_path)
    assert isinstance(together, Path)
    assert isinstance(first, Diagnosis)
    assert isinstance(second, Diagnosis)
    assert sound(together)
    labels = [one.verdict.detector[:8] for one in (first, second) if one.verdict.detector]
    assert labels[0] != labels[1]
    assert "/injected" in entities(together)
    for number, label, folder in zip((1, 2), labels, (out / "faulty", other), strict=True):
        assert f"/residuals/r_cyl/{label}/band" in entities(together)
        assert f"/{number}_{label}/diagnosed" in entities(together)
        samples = pl.read_parquet(folder / "samples.parquet")
        _, drawn = series(frames(together), f"/residuals/r_cyl/{label}/value Scalars:scalars")
        assert drawn[np.isfinite(drawn)].tolist() == samples["residual.r_cyl"].to_list()
    assert f"| {labels[0]} | {labels[1]} |" in texts(together)["/summary"]


def test_two_detectors_are_compared_on_each_log(
    detector: Detector, second: Detector, logs: Path, tmp_path: Path
) -> None:
    path = tmp_path / "both.rrd"
    write_compared(detector, second, [read_log(logs / f"{n}.parquet") for n in ("faulty", "healthy1")], path)
    assert sound(path)
    reader = RrdReader(path)
    assert len(reader.recordings()) == 2
    drawn = {
        f"/residuals/r_cyl/{who}/{what}" for who in ("champion", "challenger") for what in ("band", "value")
    }
    for one in reader.recordings():
        there = {str(chunk.entity_path) for chunk in reader.stream(store=one)}
        assert {*drawn, "/1_champion/diagnosed", "/2_challenger/diagnosed"} <= there
    with pytest.raises(LogError, match="there is no folder"):
        write_compared(detector, second, [], tmp_path / "no" / "both.rrd")


def test_two_logs_stand_side_by_side(out: Path, tmp_path: Path) -> None:
    together, *_ = to_show([str(out / "faulty"), str(out / "healthy2")], None, tmp_path)
    assert isinstance(together, Path)
    assert sound(together)
    drawn = entities(together)
    assert {"/1/signals/n_Eng", "/2/signals/n_Eng", "/1/z/r_cyl/value", "/2/diagnosed"} <= drawn


def test_what_does_not_go_together_is_named(out: Path, logs: Path, tmp_path: Path) -> None:
    log, made = read_log(logs / "faulty.parquet"), read_run(out / "faulty")
    with pytest.raises(LogError, match="expected 2 to 4"):
        write_beside([log], tmp_path / "x.rrd")
    bare = Diagnosis(log=log, samples=made.samples.select("time", "detection"), verdict=made.verdict)
    with pytest.raises(LogError, match="no residual in common"):
        write_comparison(made, bare, tmp_path / "x.rrd", ("a", "b"))
    assert not list(tmp_path.iterdir())


def test_a_layer_needs_a_recording_to_be_added_to(out: Path, other: Path, tmp_path: Path) -> None:
    from viz.timeline import write_timeline

    with pytest.raises(LogError, match="nothing to add it to"):
        layers(to_show([str(out / "faulty")], None, tmp_path), [other], tmp_path)
    base = tmp_path / "base.rrd"
    write_timeline(read_run(out / "faulty"), base)
    (layer,) = layers([base], [other], tmp_path)
    assert isinstance(layer, Path)
    assert sound(layer)
    assert any(e.startswith("/layers/found/") for e in entities(layer))
    assert layers([base], [], tmp_path) == []
