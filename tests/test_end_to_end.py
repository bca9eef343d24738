"""The main job as a user does it, by the commands alone, from nothing."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from pipeline.cli import main

DRIVES = {
    "healthy": [],
    "flow_sensor": ["--fault", "maf_gain", "--magnitude", "-0.08"],
    "intake_sensor": ["--fault", "intake_pressure_gain", "--magnitude", "-0.02"],
    "leak": ["--fault", "boost_leak", "--magnitude", "8"],
}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("user")
    logs, store = folder / "logs", str(folder / "store")
    simulate = ["simulate", "airpath", "--cycle", "udds", "--duration", "400"]
    for seed, format in ((1, "mcap"), (2, "csv")):
        assert main([*simulate, "--seed", str(seed), "--out", str(folder / f"train{seed}.{format}")]) == 0
    for seed, (name, fault) in enumerate(DRIVES.items(), start=3):
        assert main([*simulate, "--seed", str(seed), *fault, "--out", str(logs / f"{name}.mcap")]) == 0
    assert main(["ingest", str(logs), "--out", str(folder / "canonical")]) == 0
    recipe = ["--recipe", "diesel_airpath", "--store", store]
    train, calibrate = str(folder / "train1.mcap"), str(folder / "train2.csv")
    assert main(["fit", train, "--calibrate", calibrate, *recipe]) == 0
    canonical = str(folder / "canonical" / "*.mcap")
    assert main(["run", canonical, *recipe, "--out", str(folder / "out")]) == 0
    return folder / "out"


def test_verdicts_are_right(out: Path) -> None:
    summary = pl.read_parquet(out / "summary.parquet")
    found = dict(zip(summary["log"], summary["fault"], strict=True))
    assert found["healthy"] == "none"
    assert (found["flow_sensor"], found["leak"]) == ("maf_gain", "boost_leak")
    assert found["intake_sensor"] == "intake_pressure_gain"
    truth = dict(zip(summary["log"], summary["truth"], strict=True))
    assert truth == {n: f[1] if f else "none" for n, f in sorted(DRIVES.items())}
    for row in summary.filter(pl.col("truth") != "none").iter_rows(named=True):
        assert row["truth"] in row["set"].split(), row
        assert 133.0 < row["detected_s"] < 300.0


def test_every_run_left_everything(out: Path) -> None:
    for name in DRIVES:
        files = {p.name for p in (out / name).iterdir()}
        expected = {"samples.parquet", "verdict.json", "annotated.mcap", "timeline.rrd", "manifest.json"}
        isolated = {"signals.parquet"} if name.endswith("_sensor") else set()
        assert files == expected | isolated


def test_a_run_can_be_viewed_and_its_log_inspected(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(out / "leak"), "--save", str(tmp_path / "x.rrd")]) == 0
    assert (tmp_path / "x.rrd").stat().st_size > 10_000
    capsys.readouterr()
    assert main(["inspect", str(out / "leak" / "annotated.mcap"), "--json"]) == 0
    signals = json.loads(capsys.readouterr().out)["signals"]
    assert {"p_Bst", "residual.r_dp", "regime", "p.boost_leak"} <= set(signals)
