"""Faults: severity over time, their effect on the inputs of the plant, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from ingest.simulators.faults import (
    FAULTS,
    SENSORS,
    Fault,
    FaultInputs,
    fault_inputs,
    fault_problems,
    truth_events,
)

TIME = np.arange(300) / 50.0
LENGTH = 6.0


def inputs(*faults: Fault) -> FaultInputs:
    return fault_inputs(faults, TIME, LENGTH, np.random.default_rng(0))


def test_severity_is_abrupt_drifts_and_ends() -> None:
    abrupt = Fault(name="maf_gain", magnitude=0.1).severity(TIME, LENGTH)
    np.testing.assert_array_equal(abrupt, TIME >= 2.0)  # a third of the log
    drift = Fault(name="maf_gain", magnitude=0.1, onset_s=1.0, ramp_s=2.0, end_s=5.0).severity(TIME, LENGTH)
    np.testing.assert_allclose(drift, np.where(TIME < 5.0, np.clip((TIME - 1.0) / 2.0, 0.0, 1.0), 0.0))


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_changes_exactly_its_own_inputs(name: str) -> None:
    unit, _, high = FAULTS[name]
    fault = Fault(
        name=name,
        magnitude=min(0.5, high) if unit == "1" else 5.0,
        signal="p_Int" if name.startswith("sensor_") else None,
    )
    healthy, faulty = inputs(), inputs(fault)
    changed = [k for k in FaultInputs._fields if not np.array_equal(getattr(healthy, k), getattr(faulty, k))]
    expected = {"boost_leak": ["leak"], "intake_leak": ["leak"], "sensor_stuck": ["stuck", "hold"]}
    expected |= {"egr_stuck_open": ["egr"], "egr_stuck_closed": ["egr"], "sensor_offset": ["offset"]}
    assert changed == expected.get(name, ["gain"])
    for k in changed:
        before = TIME < 2.0
        np.testing.assert_array_equal(getattr(faulty, k)[before], getattr(healthy, k)[before])
    if fault.channel is not None:
        columns = np.flatnonzero((getattr(faulty, changed[0]) != getattr(healthy, changed[0])).any(axis=0))
        assert columns.tolist() == [list(SENSORS).index(fault.channel)]


def test_several_faults_add_up_in_si_units() -> None:
    both = inputs(
        Fault(name="maf_gain", magnitude=0.1, onset_s=0.0),
        Fault(name="maf_gain", magnitude=-0.04, onset_s=0.0),
        Fault(name="sensor_offset", magnitude=2.0, signal="p_Bst", onset_s=0.0),
        Fault(name="boost_leak", magnitude=4.0, onset_s=0.0),
        Fault(name="intake_leak", magnitude=3.0, onset_s=0.0),
    )
    np.testing.assert_allclose(both.gain[:, 0], 1.06)
    np.testing.assert_allclose(both.offset[:, 1], 2000.0)
    np.testing.assert_allclose(both.leak[0], np.pi / 4 * np.array([4e-3, 3e-3]) ** 2)


def test_noise_has_the_given_relative_size() -> None:
    noisy = inputs(Fault(name="sensor_noise", magnitude=0.05, signal="W_HFM", onset_s=0.0))
    assert np.std(noisy.gain[:, 0]) == pytest.approx(0.05, rel=0.15)
    assert np.mean(noisy.gain[:, 0]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (Fault(name="maf_gian", magnitude=0.1), "did you mean maf_gain"),
        (Fault(name="maf_gain", magnitude=float("nan")), "magnitude nan"),
        (Fault(name="boost_leak", magnitude=-1), r"-1; expected 0 … 30 \[mm\]"),
        (Fault(name="egr_stuck_open", magnitude=120), "expected 0 … 100"),
        (Fault(name="sensor_stuck", magnitude=0), "known: .*p_Bst"),
        (Fault(name="sensor_stuck", magnitude=0, signal="p_bst"), "did you mean p_Bst"),
        (Fault(name="boost_leak", magnitude=1, signal="p_Bst"), "p_Bst' is not part of it"),
        (Fault(name="maf_gain", magnitude=0.1, onset_s=7.0), "onset 7 s; expected within the log, 0 … 6 s"),
        (Fault(name="maf_gain", magnitude=0.1, ramp_s=-1.0), "ramp -1"),
        (Fault(name="maf_gain", magnitude=0.1, onset_s=3.0, end_s=3.0), "after its onset at 3 s"),
    ],
)
def test_what_is_wrong_is_said(fault: Fault, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        raise ValueError("; ".join(fault_problems([fault], LENGTH)))


def test_events_are_the_ground_truth() -> None:
    faults = [
        Fault(name="sensor_offset", magnitude=2.0, signal="T_Int", onset_s=1.0, end_s=4.0),
        Fault(name="boost_leak", magnitude=4.0),
    ]
    assert not list(fault_problems(faults, LENGTH))
    offset, leak = truth_events(faults, LENGTH)
    assert (offset.t_start, offset.t_end, offset.channel, offset.unit, offset.source) == (
        1,
        4,
        "T_Int",
        "K",
        "truth",
    )
    assert (leak.t_start, leak.t_end, leak.channel, leak.unit, leak.magnitude) == (2.0, None, None, "mm", 4.0)
