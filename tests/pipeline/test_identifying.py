"""A model from a log, and what a user can get wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from ingest import write_log
from ingest.errors import LogError
from ingest.log import Group, Log
from ingest.physics import zero_order_hold
from pipeline.cli import main
from pipeline.identifying import Settings, identify_log

SETTINGS = Settings(inputs=("u", "v"), outputs=("y",))


@pytest.fixture(scope="module")
def log() -> Log:
    """Poles at -1 and -0.3 ± 2i 1/s, static gains 2 (u) and -1 (v), about an operating point, at 10 Hz."""
    A = np.array([[-1.0, 0.0, 0.0], [0.0, -0.3, 2.0], [0.0, -2.0, -0.3]])
    B = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    C = np.array([[2.0, 0.0, 0.0]]) + np.array([[0.0, 1.0, 0.0]]) * (-1.0 / (0.3 / (0.09 + 4.0)))
    Ad, Bd = zero_order_hold(A, B, 0.1)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(800, 2)), 5, axis=0)
    x, y = np.zeros(3), np.empty(len(u))
    for t in range(len(u)):
        y[t] = (C @ x)[0]
        x = Ad @ x + Bd @ u[t]
    frame = pl.DataFrame({"time": 0.1 * np.arange(len(u)), "u": u[:, 0] + 5.0, "v": u[:, 1]})
    frame = frame.with_columns(y=pl.Series(y + 30.0 + rng.normal(0, 0.05, len(u))))
    return Log("made", {"bench": Group("bench", frame)})


def test_poles_gains_and_order_are_found(log: Log) -> None:
    found = identify_log(log, SETTINGS)
    assert found["order"] == 3
    poles = sorted((round(p["real"], 1), round(abs(p["imaginary"]), 1)) for p in found["poles"])
    assert poles == [(-1.0, 0.0), (-0.3, 2.0), (-0.3, 2.0)]
    assert found["gains"]["y"] == pytest.approx({"u": 2.0, "v": -1.0}, rel=0.05)
    assert found["held_out"]["simulated_percent"]["y"] > 95.0
    assert found["innovations_sd"][0] == pytest.approx(0.05, rel=0.15)
    json.dumps(found, allow_nan=False)


def test_stretches_between_gaps_add_up(log: Log) -> None:
    group = log.groups["bench"]
    holes = group.frame.filter(~pl.col("time").is_between(50, 70) & ~pl.col("time").is_between(200, 204))
    broken = replace(log, groups={"bench": replace(group, frame=holes)})
    found = identify_log(broken, replace(SETTINGS, order=3))
    assert found["gains"]["y"] == pytest.approx({"u": 2.0, "v": -1.0}, rel=0.05)
    assert found["criterion"] is None


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        (replace(SETTINGS, inputs=("w",)), "no signal 'w'"),
        (replace(SETTINGS, inputs=("y",)), "named twice"),
        (replace(SETTINGS, order=99), "orders 1 … 19"),
        (replace(SETTINGS, horizon=5000), "too few"),
    ],
)
def test_mistakes_are_told(log: Log, settings: Settings, word: str) -> None:
    with pytest.raises(LogError, match=word):
        identify_log(log, settings)


def test_the_command_prints_the_same(log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_log(log, path := tmp_path / "made.parquet")
    words = ["identify", str(path), "--input", "u", "v", "--output", "y"]
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["order"] == 3
    assert main([*words, "--order", "2", "--method", "moesp"]) == 0
    out = capsys.readouterr().out
    for part in ("made: order 2 by moesp", "time constant s", "Static gains", "singular value"):
        assert part in out
    assert main(["identify", str(path), "--input", "w", "--output", "y"]) == 2
    assert "no signal 'w'" in capsys.readouterr().err
