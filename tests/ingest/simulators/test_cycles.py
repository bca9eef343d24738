"""Drive cycles: the published durations and distances, and users' files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ingest.errors import LogError
from ingest.simulators.cycles import CYCLES, load_cycle, resample_cycle

# regulation: duration (s), distance (km)
PUBLISHED = {
    "udds": (1369, 11.99),
    "hwfet": (765, 16.51),
    "us06": (600, 12.89),
    "ftp75": (1874, 17.77),
    "wltc_3b": (1800, 23.27),
    "nedc": (1180, 11.02),
}


@pytest.mark.parametrize("name", CYCLES)
def test_builtin_cycles_have_their_published_length(name: str) -> None:
    time, speed = load_cycle(name)
    duration, distance = PUBLISHED[name]
    assert time[-1] == pytest.approx(duration, abs=2)
    assert np.trapezoid(speed, time) / 1e3 == pytest.approx(distance, rel=0.005)


@pytest.mark.parametrize(
    ("header", "factor"), [("time,v_Veh", 3.6), ("t,speed_mps", 1.0), ("time_s,speed_mph", 1 / 0.44704)]
)
def test_own_cycle_in_the_unit_its_column_names(tmp_path: Path, header: str, factor: float) -> None:
    file = tmp_path / "own.csv"
    file.write_text(header + "\n" + "\n".join(f"{5 + t},{t * factor}" for t in range(4)))
    time, speed = load_cycle(file)
    np.testing.assert_allclose(time, [0, 1, 2, 3])
    np.testing.assert_allclose(speed, [0, 1, 2, 3], rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time,velocity\n0,1\n", "velocity.*speed_kmh"),
        ("time,v_Veh\n0,1\n1,fast\n", "1 of 2 rows"),
        ("time,v_Veh\n0,1\n0,2\n", "must rise"),
        ("time,v_Veh\n0,1\n1,-2\n", "negative"),
        ("time,v_Veh\n0,1\n", "at least 2"),
        ("", "not a CSV"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(LogError, match=f"bad.csv.*{says}"):
        load_cycle(file)


def test_unknown_cycle_lists_the_near_ones() -> None:
    with pytest.raises(LogError, match="did you mean wltc_3b"):
        load_cycle("wltc3b")


def test_cut_and_repeat() -> None:
    time, speed = np.array([0.0, 10.0]), np.array([0.0, 10.0])
    assert len(resample_cycle(time, speed, 50.0, None)) == 500
    np.testing.assert_allclose(resample_cycle(time, speed, 1.0, 4.0), [0, 1, 2, 3])
    np.testing.assert_allclose(resample_cycle(time, speed, 1.0, 13.0)[10:], [0, 1, 2])
