"""The map of the LiU-ICE bench on its real logs, where they are at hand (they may not be redistributed)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ingest import read_log, write_log
from ingest.log import Log
from ingest.report import quality

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data" / "liu_ice"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the LiU-ICE logs are not at hand")


def read(name: str) -> Log:
    return read_log(DATA / name, ROOT / "data" / "maps" / "liu_ice.toml")


def test_values_are_those_of_the_file_in_canonical_units() -> None:
    log = read("wltp_NF.csv")
    raw = pl.read_csv(DATA / "wltp_NF.csv", infer_schema_length=None)
    assert log.span == (raw["time"].min(), raw["time"].max())
    for signal, channel, scale in (
        ("p_Bst", "Intercooler_pressure", 1e-3),
        ("T_Bst", "intercooler_temperature", 1.0),
        ("p_Int", "intake_manifold_pressure", 1e-3),
        ("W_HFM", "air_mass_flow", 1e3),
        ("n_Eng", "engine_speed", 60 / (2 * np.pi)),
        ("theta_Thr", "throttle_position", 1.0),
        ("u_Wg", "wastegate_position", 100.0),
        ("p_Amb", "ambient_pressure", 1e-3),
        ("T_Amb", "ambient_temperature", 1.0),
    ):
        np.testing.assert_allclose(log.values(signal), raw[channel].to_numpy() * scale, rtol=1e-14)
    assert len(log.signals) == 10
    assert "notes" not in log.facts


def test_quality_sees_the_irregular_sampling() -> None:
    found = quality(read("wltp_NF.csv"))["p_Bst"]
    assert found["rate_hz"] == pytest.approx(10.0, rel=0.01)
    assert found["jitter"] > 1.0
    assert found["gaps"] == 2
    assert not found["out_of_order"] + found["duplicates"]


@pytest.mark.parametrize("suffix", ["mcap", "parquet", "csv"])
def test_round_trip(tmp_path: Path, suffix: str) -> None:
    log = read("wltp_f_iml_6mm.csv")
    back = read_log(write_log(log, tmp_path / f"x.{suffix}"))
    assert back.groups["data"].frame.equals(log.groups["data"].frame)
    assert back.signals == log.signals
    assert (back.name, back.facts["vehicle"]) == (log.name, "LiU-ICE test bench")
