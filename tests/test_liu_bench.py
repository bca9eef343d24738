"""The main job on real logs: a petrol engine on a test bench (LiU-ICE, arXiv 2408.13269), by the commands.

The logs carry no licence, so they do not come along; where they are not there, these tests are skipped. The
onsets are those seen in the data.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl
import pytest

from ingest import read_log, write_log
from pipeline import fit, load_recipe, run
from pipeline.batch import Options

ROOT = Path(__file__).parents[1]
LOGS = ROOT.parent / "shared/data/liu_ice"
MAP = ROOT / "data/maps/liu_ice.toml"
ONSET = {
    "boost_pressure_gain": ("wltp_f_pic_090", 122.4),
    "intake_pressure_gain": ("wltp_f_pim_080", 123.75),
    "maf_gain": ("wltp_f_waf_105", 121.7),
    "intake_leak": ("wltp_f_iml_6mm", 117.65),
}
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not LOGS.is_dir(), reason="the LiU-ICE logs are not beside the repository"),
]


Rows = dict[str, dict[str, Any]]


def diagnosed(training: Path, logs: list[Path], folder: Path) -> Rows:
    """Rows of the summary by log, after a fit on ``training`` alone."""
    detector = fit([read_log(training, MAP)], load_recipe("si_airpath"))
    summary = run(logs, detector, folder, Options(timeline=False, name_map=MAP))
    return {row["log"]: row for row in summary.to_dicts()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """All five logs, fitted on the whole fault-free one."""
    logs = [LOGS / f"{name}.csv" for name in ("wltp_NF", *(name for name, _ in ONSET.values()))]
    return diagnosed(logs[0], logs, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rows, Path, float]:
    """Fitted on the first half of the fault-free log: rows, folder, and the middle of that log in s."""
    folder = tmp_path_factory.mktemp("half")
    log = read_log(LOGS / "wltp_NF.csv")
    start, end = log.span
    middle = (start + end) / 2
    first = write_log(log.between(start, middle), folder / "first.mcap")
    second = write_log(log.between(middle, end), folder / "second.mcap")
    logs = [second, *(LOGS / f"{name}.csv" for name in ("wltp_NF", *(name for name, _ in ONSET.values())))]
    return diagnosed(first, logs, folder / "out"), folder / "out", middle


def test_no_alarm_on_the_fault_free_log(whole: Rows) -> None:
    assert whole["wltp_NF"]["fault"] == "none"


@pytest.mark.parametrize("fault", ONSET)
def test_every_fault_is_detected_after_its_onset(whole: Rows, fault: str) -> None:
    name, onset = ONSET[fault]
    assert whole[name]["status"] == "ok"
    assert whole[name]["detected_s"] is not None
    assert whole[name]["detected_s"] >= onset


@pytest.mark.parametrize("fault", ONSET)
def test_faults_are_detected_soon_and_named(whole: Rows, fault: str) -> None:
    name, onset = ONSET[fault]
    assert whole[name]["detected_s"] < onset + 20
    assert whole[name]["fault"] == fault


def test_no_alarm_over_the_half_that_was_not_seen(half: tuple[Rows, Path, float]) -> None:
    _, out, middle = half
    samples = pl.read_parquet(out / "wltp_NF" / "samples.parquet").filter(pl.col("time") >= middle)
    assert samples.height > 5000
    assert samples["detection"].sum() == 0


def test_no_alarm_over_that_half_as_a_log_of_its_own(half: tuple[Rows, Path, float]) -> None:
    assert half[0]["second"]["fault"] == "none"


def test_the_half_detector_detects_every_fault(half: tuple[Rows, Path, float]) -> None:
    assert all(half[0][name]["detected_s"] is not None for name, _ in ONSET.values())


@pytest.mark.parametrize("fault", ONSET)
def test_faults_are_named_by_the_half_detector(half: tuple[Rows, Path, float], fault: str) -> None:
    rows, _, _ = half
    name, onset = ONSET[fault]
    assert rows[name]["fault"] == fault
    assert onset <= rows[name]["detected_s"] < onset + 20
