"""A replay says step by step what a run says of the whole, and nothing before its time."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from ingest import read_log
from ingest.log import Log
from pipeline import run
from pipeline.batch import Options
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.diagnosing import diagnose
from pipeline.replaying import Pace, Step, replay
from pipeline.store import Store


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Numbers and words of nested JSON by their place in it."""
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, inner in pairs for k, v in flat(inner, f"{name}/{key}").items()}
    return {name: value}


def test_the_diagnosis_is_that_of_the_whole(faulty: Log, detector: Detector) -> None:
    steps: list[Step] = []
    replayed, whole = replay(faulty, detector, steps.append), diagnose(faulty, detector)
    for said in ("fault", "signal", "set", "onset_s", "detected_s"):
        assert getattr(replayed.verdict, said) == getattr(whole.verdict, said)
    shown = pl.concat([s.samples for s in steps if s.samples.height])
    for samples in (shown, replayed.samples):  # sums in other blocks differ in their last digits
        assert_frame_equal(samples, whole.samples, rel_tol=1e-4, abs_tol=1e-6)
    assert (
        sum(s.part.groups["ecu"].frame.height for s in steps if s.part) == faulty.groups["ecu"].frame.height
    )
    for step in steps:
        if step.part is not None and step.samples.height:
            assert step.samples["time"][-1] <= step.part.span[1]


def test_what_comes_later_changes_nothing(faulty: Log, detector: Detector) -> None:
    shown: list[list[pl.DataFrame]] = [[], []]
    for log, into in zip((faulty, faulty.between(0.0, 200.0)), shown, strict=True):
        replay(log, detector, lambda step, into=into: into.append(step.samples))  # type: ignore[misc]
    long, short = (pl.concat(frames).filter(pl.col("time") < 190.0) for frames in shown)
    assert_frame_equal(long, short)


def test_the_pace_is_kept() -> None:
    pace, began = Pace(20.0), time.monotonic()
    pace.until(4.0)
    assert 0.2 <= time.monotonic() - began < 1.0
    began = time.monotonic()
    Pace(None).until(1e6)
    pace.until(1.0)  # behind: no waiting
    assert time.monotonic() - began < 0.1


def test_the_command_gives_the_verdict_of_run(
    logs: Path, store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str], detector: Detector
) -> None:
    log = logs / "faulty.parquet"
    command = ["replay", str(log), "--recipe", "diesel_airpath", "--store", str(store.folder), "--no-viewer"]
    assert main([*command, "--json"]) == 0
    told = capsys.readouterr()
    run([log], detector, tmp_path, Options(timeline=False))
    replayed, there = json.loads(told.out), json.loads((tmp_path / "faulty" / "verdict.json").read_text())
    assert replayed["fault"] == there["fault"] == "maf_gain"
    one, other = flat(replayed), flat(there)
    assert one.keys() == other.keys()
    for name, value in one.items():
        close = pytest.approx(other[name], rel=1e-4, abs=1e-6) if isinstance(value, float) else other[name]
        assert value == close, name
    assert "alarm, maf_gain" in told.err
    assert main(command) == 0
    assert "Air mass flow sensor reads wrong (maf_gain, W_HFM)" in capsys.readouterr().out


def test_mistakes_are_named(logs: Path, store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["replay", "--recipe", "diesel_airpath", "--store", str(store.folder), "--no-viewer"]
    assert main([*command, str(logs), "--speed", "0"]) == 2
    told = capsys.readouterr().err
    assert "--speed 0: expected more than 0" in told
    assert "replay takes one" in told


def test_a_browser_can_watch(logs: Path, store: Store) -> None:
    code = (
        "import signal, sys; from pipeline.cli import main; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); sys.exit(main(sys.argv[1:]))"
    )
    command = [
        sys.executable, "-c", code, "replay", str(logs / "healthy1.parquet"), "--recipe", "diesel_airpath",
        "--store", str(store.folder), "--web", "--speed", "200",
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if "the replay is over" in line:
                break
        process.send_signal(signal.SIGINT)
        out, rest = process.communicate(timeout=30)
    assert process.returncode == 0, (lines, rest)
    assert any("http://127.0.0.1:" in line for line in lines)
    assert "No fault found" in out
    assert read_log(logs / "healthy1.parquet").name in out
