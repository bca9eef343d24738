from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from ingest.log import Event, Group, Log, Signal
from stages.results import Diagnosis, Magnitude, Verdict
from viz.summary import agreement, detection_delay, log_summary, magnitude_text, regime_table, summary, table


def injected(kind: str, start: float = 10.0) -> Event:
    return Event(t_start=start, kind=kind, source="truth")


def verdict(fault: str, detected: float | None = None) -> Verdict:
    return Verdict(log="a", recipe="r", detector=None, fault=fault, detected_s=detected)


@pytest.mark.parametrize(
    ("fault", "truth", "said"),
    [
        ("boost_leak", ["boost_leak"], "correct"),
        ("boost_leak+maf_gain", ["maf_gain", "boost_leak"], "correct"),
        ("boost_leak+maf_gain", ["boost_leak+maf_gain"], "correct"),
        ("none", ["boost_leak"], "missed"),
        ("insufficient_evidence", ["boost_leak"], "missed"),
        ("maf_gain", ["boost_leak"], "wrong"),
        ("unknown", ["boost_leak"], "noticed, not named"),
        ("maf_gain", ["maf_gain", "boost_leak"], "one of the injected faults"),
    ],
)
def test_agreement_with_the_truth(fault: str, truth: list[str], said: str) -> None:
    assert agreement(verdict(fault), [injected(kind) for kind in truth]) == said


def test_the_delay_counts_from_the_injection_that_was_answered() -> None:
    events = [injected("a", 10.0), injected("b", 100.0), injected("c", 300.0)]
    assert detection_delay(verdict("b", 104.5), events) == pytest.approx(4.5)
    assert detection_delay(verdict("b", 5.0), events) is None
    assert detection_delay(verdict("b"), events) is None


@pytest.mark.parametrize(
    ("magnitude", "text"),
    [
        (Magnitude(value=0.05, sd=0.0123, unit="1"), "5.0 ± 1.2 %"),
        (Magnitude(value=4.0, sd=0.25, unit="mm"), "4.00 ± 0.25 mm"),
        (Magnitude(value=40.0, sd=12.0, unit="%"), "40 ± 12 %"),
        (Magnitude(value=3.0, sd=0.0, unit="mm"), "3.0 ± 0.0 mm"),
    ],
)
def test_magnitudes(magnitude: Magnitude, text: str) -> None:
    assert magnitude_text(magnitude) == text


def test_the_summary_says_what_happened_and_why(diagnosis: Diagnosis) -> None:
    text = summary(diagnosis)
    for part in (
        "## Leak in the boost manifold (boost_leak)",
        "201.3 s",
        "206.0 s",
        "3.80 ± 0.31 mm",
        "boost_leak 93.1%",
        "correct",
        "6.0 s",
    ):
        assert part in text
    z = diagnosis.samples.filter(pl.col("detection") > 0)["z.r_dp"].to_numpy()
    assert f"**r_dp** is far below expectation in alarm: mean {z.mean():+.1f} sigma" in text
    assert diagnosis.about is not None
    assert f"; it is {diagnosis.about.residuals['r_dp']}" in text
    assert text.index("**r_dp**") < text.index("**r_cyl**")
    assert "3f9a12c0" in text
    assert "unit assumed: u_Vnt" in text


def test_without_an_alarm_the_summary_speaks_of_the_whole_log(diagnosis: Diagnosis) -> None:
    quiet = diagnosis.samples.with_columns(detection=pl.lit(0, pl.Int8))
    text = summary(replace(diagnosis, samples=quiet, verdict=verdict("none")))
    assert text.startswith("## No fault found")
    assert "over the whole log" in text
    assert "missed" in text


def test_the_regime_table_holds_the_numbers_of_the_samples(diagnosis: Diagnosis) -> None:
    text = regime_table(diagnosis)
    rows = diagnosis.samples.filter(pl.col("regime") == 2)
    line = next(line for line in text.splitlines() if line.startswith("| R2 |"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert int(cells[1]) == rows.height
    numbers = np.array(cells[2:5], dtype=float)
    expected = [rows["residual.r_cyl"].mean(), rows["residual.r_cyl"].std(), rows["sigma.r_cyl"].median()]
    assert numbers == pytest.approx(np.array(expected, dtype=float), rel=6e-3)
    assert text.count("| R2 |") == 2


def test_a_log_without_a_run_tells_its_groups_and_remarks(log: Log) -> None:
    text = log_summary(log, ["blob: not drawn"])
    for part in (
        "| fast | 29299 | 7 | 50 Hz |",
        "boost_leak 4 mm from 200.0 s",
        "spike × 1 (p_Bst)",
        "blob",
    ):
        assert part in text


def test_cells_cannot_break_the_table() -> None:
    odd = Signal(name="a|b\nc", unit=None, flags=("x|y",))
    group = Group("g|h\n", pl.DataFrame({"time": [0.0], "a|b\nc": [1.0]}), {"a|b\nc": odd})
    text = log_summary(Log(name="l", groups={"g|h\n": group}))
    assert "g\\|h " in text
    assert table(("a",), [("x|y\nz",)]).splitlines()[-1] == "| x\\|y z |"


def test_a_log_known_to_be_fault_free_is_judged(diagnosis: Diagnosis) -> None:
    healthy = Event(t_start=0.0, kind="none", source="truth")
    log = replace(diagnosis.log, events=(healthy,))
    assert "| Against the truth | false alarm |" in summary(replace(diagnosis, log=log))
    quiet = replace(diagnosis, log=log, verdict=replace(diagnosis.verdict, fault="none"))
    text = summary(quiet)
    assert "| Injected | nothing: known to be fault-free |" in text
    assert "| Against the truth | correct |" in text
    unknown = replace(quiet, log=replace(log, events=()))
    assert "Against the truth" not in summary(unknown)
    assert "### Injected faults\n- none" in log_summary(log)
    assert "Injected faults" not in log_summary(replace(log, events=()))


def test_what_no_log_could_tell_apart_is_said(diagnosis: Diagnosis) -> None:
    pair = "boost_pressure_gain+intake_pressure_gain"
    verdict = replace(diagnosis.verdict, fault="maf_gain", statistics={"same_as": [pair]})
    assert f"{pair}, both by about as much the other way" in summary(replace(diagnosis, verdict=verdict))
    assert "the other way" not in summary(diagnosis)


def test_each_of_two_faults_has_its_size(diagnosis: Diagnosis) -> None:
    sizes = {
        "boost_leak": {"value": 4.0, "sd": 0.3, "unit": "mm"},
        "maf_gain": {"value": -0.08, "sd": 0.01, "unit": "1"},
    }
    verdict = replace(
        diagnosis.verdict, fault="boost_leak+maf_gain", magnitude=None, statistics={"magnitudes": sizes}
    )
    text = summary(replace(diagnosis, verdict=verdict))
    assert "| Magnitude of boost_leak | 4.00 ± 0.30 mm |" in text
    assert "| Magnitude of maf_gain | -8.0 ± 1.0 % |" in text
    single = replace(
        verdict, fault="boost_leak", statistics={"magnitudes": {"boost_leak": sizes["boost_leak"]}}
    )
    assert "Magnitude of" not in summary(replace(diagnosis, verdict=single))
