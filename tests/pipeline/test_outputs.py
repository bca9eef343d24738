from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import ingest
from ingest import read_log
from ingest.errors import LogError
from ingest.log import Group, Log
from pipeline import diagnose
from pipeline.detector import Detector
from pipeline.outputs import to_json, write_run
from pipeline.recipe import Recipe
from stages.results import Diagnosis

FILES = {"samples.parquet", "signals.parquet", "verdict.json", "annotated.mcap", "manifest.json"}
VERDICT_KEYS = (
    "log recipe detector fault signal set probability onset_s detected_s magnitude detectable events quality "
    "statistics"
)
EVENT_KEYS = {"t_start", "t_end", "kind", "channel", "confidence", "source"}
MANIFEST: dict[str, Any] = {"key": "k"}


@pytest.fixture(scope="module")
def diagnosis(detector: Detector, faulty: Log) -> Diagnosis:
    return diagnose(faulty, detector)


@pytest.fixture(scope="module")
def folder(diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "faulty"
    write_run(diagnosis, folder, MANIFEST, timeline=False)
    return folder


def test_the_folder_holds_these_files(folder: Path) -> None:
    assert {p.name for p in folder.iterdir()} == FILES
    assert [p.name for p in folder.parent.iterdir()] == ["faulty"]


def test_columns_and_types_of_the_samples(folder: Path, recipe: Recipe) -> None:
    schema = pl.read_parquet_schema(folder / "samples.parquet")
    residuals = [c.removeprefix("residual.") for c in schema if c.startswith("residual.")]
    isolate, pairs, _ = recipe.to_json()["stage"][-3:]
    together = [
        pair for pair in combinations(pairs["faults"], 2) if not {*pair} <= {"boost_leak", "intake_leak"}
    ]
    two = ["+".join(sorted(pair)) for pair in together]
    others = ["sensor_noise", "sensor_offset", "sensor_stuck"]
    hypotheses = [*isolate["hypotheses"], *two, *others]
    assert len(two) == 9
    assert len(residuals) >= 2
    expected = {"time": pl.Float64, "regime": pl.Int32, "in_domain": pl.Boolean, "detection": pl.Int8}
    expected |= {f"{kind}.{r}": pl.Float64 for kind in ("residual", "sigma", "z") for r in residuals}
    expected |= {f"evidence.{f}": pl.Float32 for f in hypotheses}
    expected |= {f"p.{f}": pl.Float32 for f in (*hypotheses, "unknown")}
    assert {c: schema.get(c) for c in expected} == expected
    assert {c for c in schema if c.startswith("p.")} == {c for c in expected if c.startswith("p.")}


def test_every_column_of_the_samples_is_documented(folder: Path) -> None:
    text = (Path(__file__).parents[2] / "docs/outputs.md").read_text(encoding="utf-8")
    for column in pl.read_parquet_schema(folder / "samples.parquet"):
        kind, dot, _ = column.partition(".")
        assert f"`{kind}.<" in text if dot else f"`{kind}`" in text, column


def test_values_of_the_samples(folder: Path) -> None:
    samples = pl.read_parquet(folder / "samples.parquet")
    detection = samples["detection"].to_numpy()
    total = samples.select(pl.sum_horizontal(pl.selectors.starts_with("p."))).to_series().to_numpy()
    assert set(detection) == {0, 1}
    np.testing.assert_allclose(total[detection == 1], 1.0, atol=1e-5)
    assert (total[detection == 0] == 0).all()
    assert samples["time"].is_sorted()
    assert samples.select(pl.selectors.starts_with("evidence.")).null_count().sum_horizontal().item() == 0
    residuals = [c.removeprefix("z.") for c in samples.columns if c.startswith("z.")]
    for r in residuals:
        ratio = samples[f"residual.{r}"] / samples[f"sigma.{r}"]
        np.testing.assert_allclose(samples[f"z.{r}"].to_numpy(), ratio.to_numpy(), rtol=1e-9)


def test_verdict(folder: Path, detector: Detector) -> None:
    verdict = json.loads((folder / "verdict.json").read_text())
    assert list(verdict) == VERDICT_KEYS.split()
    assert (verdict["log"], verdict["recipe"], verdict["detector"]) == (
        "faulty",
        "diesel_airpath",
        detector.key,
    )
    assert (verdict["fault"], verdict["signal"]) == ("maf_gain", "W_HFM")
    assert verdict["set"] == [f for f in verdict["set"] if verdict["probability"][f] > 0.05]
    assert {f for f, p in verdict["probability"].items() if p > 0.05} == set(verdict["set"])
    assert sum(verdict["probability"].values()) == pytest.approx(1.0, abs=1e-4)
    assert 133.0 <= verdict["onset_s"] <= verdict["detected_s"] < 160.0
    assert verdict["events"]
    assert all(set(event) >= EVENT_KEYS for event in verdict["events"])
    samples = pl.read_parquet(folder / "samples.parquet")
    assert verdict["detected_s"] in samples.filter(pl.col("detection") == 1)["time"].to_list()


def test_annotated_log_reads_back(folder: Path, diagnosis: Diagnosis, faulty: Log) -> None:
    log = read_log(folder / "annotated.mcap")
    samples = pl.read_parquet(folder / "samples.parquet")
    for name, group in faulty.groups.items():
        assert log.groups[name].frame.equals(group.frame, null_equal=True)
    for column in samples.columns[1:]:
        assert log.group_of(column).frame[column].equals(samples[column], null_equal=True), column
    assert log.signals["residual.r_dp"].unit == log.signals["sigma.r_dp"].unit == "kPa"
    assert log.signals["regime"].resample == "hold"
    assert [e.kind for e in log.events if e.source == "truth"] == ["maf_gain"]
    assert tuple(e for e in log.events if e.source == "dynoscope") == diagnosis.verdict.events


def test_annotated_log_can_be_diagnosed_again(folder: Path, detector: Detector, tmp_path: Path) -> None:
    log = read_log(folder / "annotated.mcap")
    again = diagnose(log, detector)
    write_run(again, tmp_path / "x", MANIFEST, timeline=False)
    twice = read_log(tmp_path / "x" / "annotated.mcap")
    assert list(twice.signals) == list(log.signals)
    assert len(twice.events) == len(log.events)


def test_channel_with_the_name_of_a_result_is_kept(faulty: Log, detector: Detector, tmp_path: Path) -> None:
    own = Group("own", pl.DataFrame({"time": [0.0, 1.0], "regime": [7.0, 8.0], "detection": [0.5, 0.5]}))
    log = replace(faulty, groups={**faulty.groups, "own": own})
    write_run(diagnose(log, detector), tmp_path / "x", MANIFEST, timeline=False)
    back = read_log(tmp_path / "x" / "annotated.mcap")
    assert back.values("regime").tolist() == [7.0, 8.0]
    assert back.group_of("dynoscope.regime").frame.height == 800


def test_a_new_run_takes_the_place_of_an_old_one(diagnosis: Diagnosis, tmp_path: Path) -> None:
    folder = tmp_path / "faulty"
    write_run(diagnosis, folder, {"key": "old"}, timeline=False)
    write_run(diagnosis, folder, {"key": "new"}, timeline=False)
    assert json.loads((folder / "manifest.json").read_text())["key"] == "new"
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.parametrize("there", [False, True], ids=["first run", "an old run"])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, OSError])
def test_a_crash_in_the_middle_leaves_all_as_it_was(
    diagnosis: Diagnosis,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    there: bool,
    error: type[BaseException],
) -> None:
    folder = tmp_path / "faulty"
    if there:
        write_run(diagnosis, folder, {"key": "old"}, timeline=False)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    def crash(log: Log, path: Path) -> None:
        assert path.parent != folder
        path.write_bytes(b"half")
        raise error("crash")

    monkeypatch.setattr(ingest, "write_log", crash, raising=False)
    with pytest.raises(error):
        write_run(diagnosis, folder, {"key": "new"}, timeline=False)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    assert [p.name for p in tmp_path.iterdir()] == (["faulty"] if there else [])


def test_a_rename_that_fails_keeps_the_old_run(
    diagnosis: Diagnosis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "faulty"
    write_run(diagnosis, folder, {"key": "old"}, timeline=False)
    rename = Path.rename

    def unlucky(self: Path, target: Path) -> Path:
        if self != folder and Path(target) == folder and not self.name.endswith(".old"):
            raise OSError("no space left")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", unlucky)
    with pytest.raises(OSError, match="no space left"):
        write_run(diagnosis, folder, {"key": "new"}, timeline=False)
    assert json.loads((folder / "manifest.json").read_text())["key"] == "old"
    assert list(tmp_path.iterdir()) == [folder]


def test_a_folder_that_is_no_run_is_not_replaced(diagnosis: Diagnosis, tmp_path: Path) -> None:
    """Such as what `ingest` wrote beside the log."""
    (tmp_path / "faulty").mkdir()
    (tmp_path / "faulty" / "ecu.parquet").write_bytes(b"precious")
    with pytest.raises(LogError, match="is not a run's folder; choose another --out"):
        write_run(diagnosis, tmp_path / "faulty", MANIFEST, timeline=False)
    assert (tmp_path / "faulty" / "ecu.parquet").read_bytes() == b"precious"


def test_json_has_no_nan() -> None:
    assert to_json({"a": "ü"}) == '{\n "a": "ü"\n}\n'
    with pytest.raises(ValueError):
        to_json({"a": float("nan")})
