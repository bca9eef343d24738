"""Recipe `throttle` from file to files, without a store and with one."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import IO, Any

import numpy as np
import polars as pl
import pytest

from ingest import read_log, write_log
from ingest.blocks import rows
from ingest.errors import StoreError
from ingest.recording import recording
from ingest.simulators.faults import Fault
from ingest.simulators.throttle import simulate_throttle
from pipeline import load_recipe, run
from pipeline.cli import main
from pipeline.detector import unfitted_detector
from pipeline.outputs import ANNOTATED, SIGNALS

INDICATORS = ("tau_tps", "k_tps", "k_et", "a1", "a2", "a3")
FAULTS = ("tps_time_constant", "tps_gain", "motor_torque_constant", "back_emf_constant")


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A weak sensor and a healthy one, run without a store."""
    folder = tmp_path_factory.mktemp("throttle")
    fault = Fault(name="tps_gain", magnitude=-0.3, onset_s=17.0, ramp_s=5.0)
    for name, faults in (("weak", [fault]), ("healthy", [])):
        write_log(simulate_throttle(seed=21, duration_s=24.0, faults=faults), folder / f"{name}.parquet")
    logs = [str(folder / f"{name}.parquet") for name in ("healthy", "weak")]
    assert main(["run", *logs, "--recipe", "throttle", "--out", str(folder / "out"), "--no-timeline"]) == 0
    return folder / "out"


def test_verdicts(out: Path) -> None:
    summary = pl.read_csv(out / "summary.csv")
    assert dict(zip(summary["log"], summary["fault"], strict=True)) == {"healthy": "none", "weak": "tps_gain"}
    verdict = json.loads((out / "weak" / "verdict.json").read_text())
    assert verdict["signal"] == "theta_ang"
    assert verdict["magnitude"]["value"] == pytest.approx(-0.3, abs=0.03)
    assert 16.0 <= verdict["onset_s"] <= verdict["detected_s"] <= 21.0
    assert verdict["statistics"]["truth"] == ["tps_gain"]


def test_samples_are_one_row_per_window(out: Path) -> None:
    samples = pl.read_parquet(out / "weak" / "samples.parquet")
    assert samples["time"].to_list() == pytest.approx([float(t) for t in range(1, 25)])
    wanted = {f"{kind}.{name}" for kind in ("indicator", "sigma", "z") for name in INDICATORS}
    wanted |= {f"{kind}.{f}" for kind in ("evidence", "p") for f in (*FAULTS, "unknown")}
    assert {"detection", *wanted} <= set(samples.columns)
    assert samples.schema["detection"] == pl.Int8
    assert samples.schema["p.tps_gain"] == pl.Float32
    total = samples.select(pl.sum_horizontal("^p\\..*$")).to_series().to_numpy()
    np.testing.assert_allclose(total, samples["detection"].to_numpy(), atol=1e-6)


def test_the_corrected_signal_is_written_where_a_sensor_was_isolated(out: Path) -> None:
    signals = pl.read_parquet(out / "weak" / SIGNALS)
    truth = read_log(out.parent / "weak.parquet").values("truth.theta_ang")
    late = signals["time"].to_numpy() > 22.5
    raw, corrected = (signals[c].to_numpy()[late] - truth[late] for c in ("theta_ang", "theta_ang.corrected"))
    assert np.std(corrected) < 0.15 * np.std(raw)
    annotated = read_log(out / "weak" / ANNOTATED)
    assert annotated.signals["theta_ang.corrected"].unit == "V"
    np.testing.assert_allclose(
        annotated.values("theta_ang.corrected"), signals["theta_ang.corrected"].to_numpy()
    )
    assert "theta_ang.corrected" not in read_log(out / "healthy" / ANNOTATED).signals
    healthy = pl.read_parquet(out / "healthy" / SIGNALS)
    np.testing.assert_array_equal(healthy["theta_ang.corrected"].to_numpy(), healthy["theta_ang"].to_numpy())


def test_a_reference_can_be_stored(out: Path, tmp_path: Path) -> None:
    log, store = str(out.parent / "healthy.parquet"), str(tmp_path / "store")
    assert main(["fit", log, "--recipe", "throttle", "--store", store]) == 0
    words = [
        "run",
        str(out.parent / "weak.parquet"),
        "--recipe",
        "throttle",
        "--store",
        store,
        "--no-timeline",
    ]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    samples = pl.read_parquet(tmp_path / "out" / "weak" / "samples.parquet")
    assert samples["z.k_tps"].null_count() <= 1  # judged from the first window on
    assert pl.read_csv(tmp_path / "out" / "summary.csv")["fault"].to_list() == ["tps_gain"]


def test_a_recipe_that_must_learn_wants_a_store() -> None:
    with pytest.raises(StoreError, match="--store"):
        unfitted_detector(load_recipe("diesel_airpath"))


def test_the_recipe_of_the_second_plant_is_right() -> None:
    recipe = load_recipe(Path(__file__).parents[2] / "data" / "recipes" / "thermocouple.toml")
    assert recipe.signals == ("T_gas", "P_heater")
    assert unfitted_detector(recipe).key == unfitted_detector(recipe).key


def test_a_table_without_time_is_run_at_a_rate_and_hashed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = simulate_throttle(seed=22, duration_s=2.0)
    path, hashed = tmp_path / "bare.csv", []
    log.groups["throttle"].frame.drop("time").write_csv(path)
    digest = hashlib.file_digest

    def noted(file: IO[bytes], name: str) -> Any:
        hashed.append(Path(file.name).name)
        return digest(file, name)  # type: ignore[arg-type]

    monkeypatch.setattr(hashlib, "file_digest", noted)
    words = ["run", str(path), "--recipe", "throttle", "--out", str(tmp_path / "out"), "--no-timeline"]
    assert main([*words, "--rate", "10000"]) == 0
    assert hashed == ["bare.csv"]
    assert pl.read_parquet(tmp_path / "out" / "bare" / "samples.parquet").height == 2
    assert main([*words, "--dbc", str(tmp_path / "lost.dbc")]) == 2
    assert "lost.dbc: there is no such file" in capsys.readouterr().err


def test_in_parts_it_says_the_same(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows and the corrected signal of a log that is too large for memory, 1500 rows at a time."""
    monkeypatch.setattr("pipeline.task.WHOLE_BYTES", 0)
    log = read_log(out.parent / "weak.parquet")
    with recording(tmp_path / "weak.parquet", log) as recorder:
        for part in rows(log, 1500):
            recorder.add(part)
        recorder.finish(log, {})
    run([tmp_path / "weak.parquet"], unfitted_detector(load_recipe("throttle")), tmp_path / "out")
    folder = tmp_path / "out" / "weak"
    for file in ("samples.parquet", SIGNALS):
        one, other = pl.read_parquet(folder / file), pl.read_parquet(out / "weak" / file)
        assert one.schema == other.schema
        for c in one.columns:
            x, y = (f[c].cast(pl.Float64).fill_null(np.nan).to_numpy() for f in (one, other))
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6, err_msg=c)
    found, known = read_log(folder / ANNOTATED), read_log(out / "weak" / ANNOTATED)
    assert list(found.signals) == list(known.signals)
    corrected = "theta_ang.corrected"
    np.testing.assert_allclose(found.values(corrected), known.values(corrected), rtol=1e-4)
