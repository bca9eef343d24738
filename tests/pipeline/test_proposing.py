from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from ingest import write_log
from ingest.errors import LogError
from ingest.log import Log
from pipeline import run
from pipeline.batch import Options
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.proposing import Proposal, propose
from pipeline.store import Store


@pytest.fixture(scope="module")
def batch(
    detector: Detector, healthy: list[Log], faulty: Log, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp("batch")
    logs = [*healthy, faulty, healthy[0].between(0.0, 60.0)]
    names = ["one", "two", "maf", "short"]
    paths = [folder / f"{name}.parquet" for name in names]
    for log, path in zip(logs, paths, strict=True):
        write_log(log, path)
    (folder / "bad.csv").write_text("not a log")
    run([*paths, folder / "bad.csv"], detector, folder / "out", Options(timeline=False))
    return folder


def by_log(batch: Path) -> dict[str, Proposal]:
    return {p.log: p for p in propose(batch / "out")}


def test_fault_free_logs_are_proposed_with_the_reason(batch: Path) -> None:
    found = by_log(batch)
    assert {n for n, p in found.items() if p.proposed} == {"one", "two"}
    assert found["one"].why == "fault-free, at known operating points"
    assert Path(found["one"].path) == batch / "one.parquet"
    assert found["maf"].why == "verdict maf_gain"
    assert found["short"].why in ("only 0 s of usable samples", "verdict insufficient_evidence")
    assert found["bad"].why.startswith("failed: ")


def test_a_log_that_is_not_what_was_read_any_more(batch: Path, tmp_path: Path) -> None:
    content = (batch / "two.parquet").read_bytes()
    try:
        (batch / "two.parquet").write_bytes(content + b"x")
        assert by_log(batch)["two"].why == "the log has changed since"
        (batch / "two.parquet").unlink()
        assert by_log(batch)["two"].why == "the log is not there any more"
    finally:
        (batch / "two.parquet").write_bytes(content)


def test_evidence_near_the_threshold_and_bad_quality(batch: Path) -> None:
    folder = batch / "out" / "one"
    verdict, samples = (folder / n for n in ("verdict.json", "samples.parquet"))
    said, frame = verdict.read_text(), pl.read_parquet(samples)
    try:
        near = frame.with_columns(statistic=pl.lit(-1.5))
        near.write_parquet(samples)
        assert by_log(batch)["one"].why == "evidence comes within 1.5 of its threshold"
        changed = json.loads(said)
        changed["quality"]["p_Int"]["stuck"] = 1
        verdict.write_text(json.dumps(changed))
        assert by_log(batch)["one"].why.startswith("quality of p_Int")
    finally:
        verdict.write_text(said)
        frame.write_parquet(samples)


def test_new_operating_points_are_a_merit(batch: Path) -> None:
    samples = batch / "out" / "one" / "samples.parquet"
    frame = pl.read_parquet(samples)
    try:
        frame.with_columns(in_domain=pl.int_range(pl.len()) % 4 != 0).write_parquet(samples)
        assert by_log(batch)["one"].why in {
            f"fault-free, {n} % at new operating points" for n in range(23, 28)
        }
    finally:
        frame.write_parquet(samples)


def test_no_batch(tmp_path: Path, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(LogError, match="is not the folder of a batch"):
        propose(tmp_path)
    words = ["retrain", "--recipe", "diesel_airpath", "--store", str(store.folder)]
    assert main(words) == 2
    assert "no LOG to train on" in capsys.readouterr().err
    assert main([*words, "--from-run", str(tmp_path)]) == 2
    assert "is not the folder of a batch" in capsys.readouterr().err
