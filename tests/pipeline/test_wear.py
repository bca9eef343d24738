"""What ``adapt --out`` leaves is drawn in the report of the batch and in its overview."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import static, titles

from ingest.errors import LogError
from pipeline.reporting import write_report
from pipeline.summary import summary_frame
from pipeline.wear import check_batch, keep_wear, wear_of_batch
from viz.colours import EXCEEDANCE, SKY_BLUE
from viz.plane import HEIGHT

LOGS, REFERENCE = 12, 5


def adapted(vehicle: str | None = "van", alarms: int = 2) -> dict[str, Any]:
    """Wear that grows by 0.1 % a log, and evidence in the last ``alarms`` logs."""
    drives = [
        {
            "log": f"d{i}", "T": 100.0 if i >= LOGS - alarms else 4.0, "alarm": i >= LOGS - alarms,
            "learned": i < LOGS - alarms, "faults": {"maf_gain": -0.08} if i >= LOGS - alarms else {},
            "denial": -0.5, "wear": {"restriction": {"value": 0.001 * i, "sd": 0.0005}},
        }
        for i in range(LOGS)
    ]  # fmt: skip
    budgets = {"restriction": {"per_100_drives": 0.2, "total": 0.6, "unit": "1"}}
    return {
        "vehicle": vehicle, "detector": "k", "commissioning": REFERENCE, "threshold": 25.0,
        "budgets": budgets, "drives": drives,
    }  # fmt: skip


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A batch of two logs, of which nothing but the table and their folders is left."""
    rows = [{"log": name, "status": "ok", "fault": "none", "vehicle": "van"} for name in ("d0", "d1")]
    summary_frame(rows).write_parquet(tmp_path / "summary.parquet")
    return tmp_path


def test_the_report_shows_wear_and_what_is_no_wear(out: Path) -> None:
    assert "Wear from log to log" not in write_report(out).read_text("utf-8")
    keep_wear(out, adapted())
    page = write_report(out).read_text("utf-8")
    assert "restriction: 1.10 ± 0.05 % (budget 20 % in 100 logs, 60 % in all) after d11" in page
    assert "alarm in 2 of 12 logs, first in d10" in page
    assert "in d11 it may be maf_gain -0.08" in page
    assert "evidence of a fault [sigma]" in page
    assert "restriction [%]" in page


def test_vehicles_stand_beside_each_other_and_a_later_report_takes_the_place(out: Path) -> None:
    for vehicle, alarms in (("van", 2), (None, 0), ("van", 0)):
        keep_wear(out, adapted(vehicle, alarms))
    one, two = wear_of_batch(out)
    assert (one.vehicle, two.vehicle) == ("van", "no vehicle")
    assert "no fault beyond the wear" in one.words()
    doubtful = adapted("van", 0)
    doubtful["drives"][-1] |= {"T": 30.0, "learned": False}
    keep_wear(out, doubtful)
    assert (
        "evidence of a fault in d11; in a second log in a row it is an alarm" in wear_of_batch(out)[0].words()
    )


def test_wear_that_does_not_show_where_it_must_is_said(out: Path) -> None:
    for z, said in ((1.0, False), (None, False), (3.21, True)):
        report = adapted("van", 0)
        report["drives"][-1]["denial"] = z
        keep_wear(out, report)
        words = " ".join(wear_of_batch(out)[0].words())
        assert ("does not show where it must (3.2 standard deviations)" in words) == said


def test_the_overview_draws_every_log_at_its_number(out: Path, tmp_path: Path) -> None:
    from viz.overview import write_overview

    keep_wear(out, adapted())
    path = tmp_path / "overview.rrd"
    write_overview("batch", [], path, 0, None, wear_of_batch(out))
    assert {"evidence of a fault [sigma] over the logs", "restriction [%] over the logs"} <= titles(path)
    found = static(path)
    evidence = np.array(found["/wear/van/evidence\\ of\\ a\\ fault/dots Points2D:positions"])
    colours = found["/wear/van/evidence\\ of\\ a\\ fault/dots Points2D:colors"]
    of = [r << 24 | g << 16 | b << 8 | 255 for r, g, b in (SKY_BLUE, EXCEEDANCE)]
    assert colours == [of[0]] * 10 + [of[1]] * 2
    assert np.unique(np.diff(evidence[:, 0]).round(3)).size == 1
    assert evidence[:, 1].min() >= -HEIGHT
    assert evidence[0, 1] / evidence[-1, 1] == pytest.approx(0.2)  # 2 sigma of 10
    bars = np.array(found["/wear/van/restriction/bars LineStrips2D:strips"])
    assert bars.shape == (LOGS, 2, 2)
    lengths = bars[:, 0, 1] - bars[:, 1, 1]
    assert lengths == pytest.approx(np.full(LOGS, lengths[0]))
    assert len(found["/wear/van/restriction/line_0 LineStrips2D:strips"]) == 1


@pytest.mark.parametrize("text", ["{", "3", '{"van": {}}', '{"van": 3}'])
def test_a_damaged_file_is_named(out: Path, text: str) -> None:
    (out / "wear.json").write_text(text)
    with pytest.raises(LogError, match=r"wear\.json cannot be read .* `dynoscope adapt --out`"):
        write_report(out)


def test_only_a_batch_is_given_wear(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="is not the folder of a batch"):
        check_batch(tmp_path)
