from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import polars as pl
import pytest

from ingest.log import Group, Log, Signal
from ingest.maps import load_map
from ingest.proposal import as_toml, propose


def log_of(channels: Mapping[str, tuple[str | None, float]]) -> Log:
    frame = pl.DataFrame({"time": [0.0, 1.0]} | {n: [v, v] for n, (_, v) in channels.items()})
    return Log("x", {"g": Group("g", frame, {n: Signal(name=n, unit=u) for n, (u, _) in channels.items()})})


LIU = {
    "Intercooler_pressure": "p_Bst", "intercooler_temperature": "T_Bst", "intake_manifold_pressure": "p_Int",
    "air_mass_flow": "W_HFM", "engine_speed": "n_Eng", "throttle_position": "theta_Thr",
    "wastegate_position": "u_Wg", "injected_fuel_mass": "m_Fuel",
    "ambient_pressure": "p_Amb", "ambient_temperature": "T_Amb",
}  # fmt: skip


def test_names_of_a_bench() -> None:
    found = propose(log_of(dict.fromkeys([*LIU, "noise_level", "boost_pressure_setpoint"], (None, 1.0))))
    assert found == {signal: channel for channel, signal in LIU.items()}


def test_a_unit_that_does_not_fit_speaks_against_a_name() -> None:
    channels = {"BoostPressure": ("V", 1.0), "pBoost": ("hPa", 1000.0), "nEngine": ("U/min", 900.0)}
    assert propose(log_of(channels)) == {"p_Bst": "pBoost", "n_Eng": "nEngine"}


def test_signals_that_are_there_are_not_proposed() -> None:
    assert propose(log_of({"p_Bst": ("kPa", 100.0), "boost_pressure": ("kPa", 100.0)})) == {}


@pytest.mark.parametrize(
    ("value", "unit"), [(101_325.0, "Pa"), (1.01, "bar"), (1013.0, "mbar"), (101.0, "kPa"), (1e9, "kPa")]
)
def test_unit_by_the_values(tmp_path: Path, value: float, unit: str) -> None:
    log = log_of({"intake pressure": (None, value), "odd\n[x]": ("V", 1.0)})
    path = tmp_path / "map.toml"
    path.write_text(as_toml(log, propose(log)))
    names = load_map(path)
    assert (names.signals["p_Int"].source, names.signals["p_Int"].unit) == (("intake pressure",), unit)
