"""The poles' plane and the plots of a monitored sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
import rerun as rr

from ingest.log import Group, Log, Signal
from stages.results import Diagnosis, Verdict
from viz.monitoring import log_monitoring, place, poles


def diagnosis(
    signals: Group | None = None, columns: dict[str, list[float | None]] | None = None
) -> Diagnosis:
    samples = pl.DataFrame({"time": [1.0, 2.0], "detection": [0, 0], **(columns or {})})
    verdict = Verdict(log="a", recipe="throttle", detector=None, fault="none")
    return Diagnosis(log=Log("a", {}), samples=samples, verdict=verdict, signals=signals)


COEFFICIENTS: dict[str, list[float | None]] = {
    "indicator.tau_s": [0.01, None], "indicator.a1": [3.0, 3.0], "indicator.a2": [2.0, 2.0],
    "indicator.k_p": [1.0, 1.0],
}  # fmt: skip


def test_poles_are_the_roots_of_the_coefficients_and_the_sensors() -> None:
    time, found = poles(diagnosis(columns=COEFFICIENTS))
    assert time.tolist() == [1.0, 2.0]
    np.testing.assert_allclose(sorted(found[0].real), [-100.0, -2.0, -1.0])
    assert np.isnan(found[1]).all()


def test_places_keep_the_angle_and_count_decades() -> None:
    at = place(np.array([-1.0 + 1.0j, -100.0, 0.0]), 1.0)
    assert at[0, 0] == pytest.approx(at[0, 1])  # pictures count y downwards
    assert at[1].tolist() == pytest.approx([-20.0 * np.log10(101.0), 0.0])
    assert at[2].tolist() == [0.0, 0.0]


def test_nothing_is_drawn_of_a_run_without_a_monitor() -> None:
    with rr.RecordingStream("test") as rec:
        assert log_monitoring(rec, diagnosis()) is None


def test_readings_and_errors_against_the_truth() -> None:
    time = np.arange(5.0)
    frame = pl.DataFrame(
        {"time": time, "y": [1.0] * 5, "y.corrected": [2.0] * 5, "y.corrected_sd": [0.1] * 5}
    )
    group = Group("signals", frame, {n: Signal(name=n, unit="V") for n in frame.columns[1:]})
    known = diagnosis(group, COEFFICIENTS)
    truth = Log("a", {"truth": Group("truth", pl.DataFrame({"time": time, "truth.y": [2.5] * 5}))})
    with rr.RecordingStream("test") as rec:
        without, compared = log_monitoring(rec, known), log_monitoring(rec, replace(known, log=truth))
    assert without is not None
    assert compared is not None
    assert without.errors is not None
    assert compared.errors is not None
    assert without.readings == compared.readings
    assert (without.errors[0], compared.errors[0]) == ("Correction of y [V]", "Error of y [V]")
    assert compared.errors[1][0] < -1.5
    assert compared.poles is not None
