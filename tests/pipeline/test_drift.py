"""A batch of made-up runs: residuals that move, widen, or leave the domain from some log on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from rerun.chunk import RrdReader

from ingest.errors import LogError
from pipeline.cli import main
from pipeline.drift import drift_report
from pipeline.reporting import drift_of_batch, write_report
from pipeline.summary import summary_frame
from viz.overview import write_overview

RUNS = 24


def batch(
    folder: Path,
    *,
    step: float = 0.0,
    wide: float = 1.0,
    outside: float = 0.0,
    fault: str = "none",
    alarm: float = 0.0,
) -> Path:
    """Runs of which the second half differs; the last share ``alarm`` of it is in alarm, far off. The summary
    lists them in no order."""
    rng = np.random.default_rng(0)
    rows: list[dict[str, Any]] = []
    for i in range(RUNS):
        late = i >= RUNS // 2
        n = 200
        level = 0.3 * rng.normal()
        e = level + (step if late else 0.0) + rng.normal(size=n) * (wide if late else 1.0)
        seen = np.arange(n) >= n * (1.0 - (alarm if late else 0.0))
        e = np.where(seen, 50.0, e)
        samples = pl.DataFrame({
            "time": np.arange(n) * 0.5, "regime": rng.integers(0, 3, size=n).astype(np.int32),
            "in_domain": rng.uniform(size=n) >= (outside if late else 0.0), "gate": np.ones(n),
            "detection": seen.astype(np.int8),
            "residual.r": e, "sigma.r": np.ones(n),
        })  # fmt: skip
        name = f"log{i:02d}"
        (folder / name).mkdir(parents=True)
        samples.write_parquet(folder / name / "samples.parquet")
        rows.append({"log": name, "status": "ok", "fault": fault if late else "none",
                     "start_time": f"2026-01-{i + 1:02d}T00:00:00"})  # fmt: skip
    rows.append({"log": "bad", "status": "failed", "reason": "?"})
    summary_frame(rows[::-1]).write_parquet(folder / "summary.parquet")
    return folder


def test_without_a_change_there_is_no_reason_to_retrain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = batch(tmp_path)
    report = drift_report(folder)
    assert report["logs"] == [f"log{i:02d}" for i in range(RUNS)]
    assert report["advice"] == []
    assert not report["retrain"]
    assert json.loads((folder / "drift.json").read_text()) == report
    table = pl.read_parquet(folder / "drift.parquet")
    whole = table.filter(regime=-1)
    assert whole.height == RUNS
    by_regime = table.filter(pl.col("regime") >= 0).group_by("log").agg(pl.col("n").sum())
    assert set(by_regime["n"]) == {200}
    assert main(["drift", str(folder)]) == 0
    assert "nothing has moved" in capsys.readouterr().out


def test_a_step_is_told_with_its_log_and_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = drift_report(batch(tmp_path, step=2.0))
    whole = next(s for s in report["series"] if s["regime"] == -1)
    assert whole["drift"]["moved"] == pytest.approx(2.0, abs=0.4)
    (advice,) = report["advice"]
    assert advice["since"] == "log12"
    assert advice["do"].startswith("look for a fault or wear first")
    assert main(["drift", str(tmp_path), "--regimes"]) == 0
    said = capsys.readouterr().out
    assert "log12" in said
    assert len([line for line in said.splitlines() if line.startswith("r ")]) == 4


def test_new_operating_points_are_a_reason_to_retrain(tmp_path: Path) -> None:
    report = drift_report(batch(tmp_path, outside=0.3))
    (advice,) = report["advice"]
    assert report["retrain"]
    assert advice["since"] == "log12"
    assert advice["why"].startswith(("29 %", "30 %", "31 %"))


def test_a_wider_residual_is_a_reason_to_calibrate(tmp_path: Path) -> None:
    (advice,) = drift_report(batch(tmp_path, wide=2.0))["advice"]
    assert advice["do"].startswith("calibrate again")


def test_logs_with_alarms_are_not_to_be_trained_on(tmp_path: Path) -> None:
    (advice,) = drift_report(batch(tmp_path, fault="maf_gain"))["advice"]
    assert advice["why"] == "6 of the last 6 logs have one, most often maf_gain"
    assert "do not train on these logs" in advice["do"]


@pytest.mark.parametrize("alarm", [0.4, 1.0])
def test_samples_in_alarm_say_nothing_of_the_drift(tmp_path: Path, alarm: float) -> None:
    report = drift_report(batch(tmp_path, alarm=alarm))
    assert report["advice"] == []
    whole = pl.read_parquet(tmp_path / "drift.parquet").filter(pl.col("regime") == -1)
    assert whole["n"][-1] == round(200 * (1.0 - alarm))
    assert whole.filter(pl.col("n") > 0)["mean"].abs().max() < 2.0  # type: ignore[operator]


def test_what_cannot_be_reported(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is not the folder of a batch"):
        drift_report(tmp_path)
    folder = batch(tmp_path / "few")
    frame = pl.read_parquet(folder / "summary.parquet")
    frame.head(4).write_parquet(folder / "summary.parquet")
    with pytest.raises(LogError, match=r"3 run.* too few to see a drift; at least 5"):
        drift_report(folder)


def test_the_report_of_the_batch_shows_the_drift(tmp_path: Path) -> None:
    folder = batch(tmp_path, step=2.0)
    assert "Drift from log to log" not in write_report(folder).read_text("utf-8")
    advice = drift_report(folder)["advice"]
    page = write_report(folder).read_text("utf-8")
    assert "mean of r [sigma]" in page
    assert f"since {advice[0]['since']}: r has moved by" in page
    assert page.count("<svg") == 1
    overview = folder / "overview.rrd"
    write_overview("batch", [], overview, 0, drift_of_batch(folder, []))
    (dots,) = (
        chunk.to_record_batch()["Points2D:positions"].to_pylist()[0]
        for chunk in RrdReader(overview).stream()
        if str(chunk.entity_path) == "/drift/plots/r/dots"
    )
    assert len(dots) == RUNS
    assert max(y for _, y in dots[RUNS // 2 :]) < min(y for _, y in dots[: RUNS // 2])  # downwards
    (folder / "drift.json").write_text("{")
    with pytest.raises(LogError, match="make it again with `dynoscope drift"):
        write_report(folder)
