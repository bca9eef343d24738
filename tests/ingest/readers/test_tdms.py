from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ingest import read_log
from ingest.errors import LogError
from ingest.files import read_header
from ingest.maps import NameMap, TimeMap

nptdms = pytest.importorskip("nptdms")
N = 1000
VALUES = np.random.default_rng(0).normal(size=N)


def write(path: Path, segments: int = 1) -> Path:
    wave = {"wf_increment": 0.01, "wf_start_offset": 0.5, "unit_string": "bar"}
    wave["wf_start_time"] = np.datetime64("2024-05-01T12:00:00")
    with nptdms.TdmsWriter(path) as writer:
        for i in range(segments):
            part = slice(i * N // segments, (i + 1) * N // segments)
            writer.write_segment(
                [
                    nptdms.ChannelObject("fast", "p_Bst", VALUES[part], wave),
                    nptdms.ChannelObject("slow", "Time", np.arange(N)[part] * 0.1, {"unit_string": "s"}),
                    nptdms.ChannelObject("slow", "T", VALUES[part].astype(np.float32), {"unit_string": "°C"}),
                    nptdms.ChannelObject("notes", "text", ["a", "b"]),
                ]
            )
    return path


@pytest.mark.parametrize("segments", [1, 10])
def test_waveforms_and_time_channels(tmp_path: Path, segments: int) -> None:
    log = read_log(write(tmp_path / "x.tdms", segments))
    np.testing.assert_allclose(log.groups["fast"].time, 0.5 + 0.01 * np.arange(N))
    np.testing.assert_allclose(log.values("p_Bst"), VALUES * 100.0)
    assert log.signals["p_Bst"].source_unit == "bar"
    np.testing.assert_array_equal(log.values("T"), VALUES.astype(np.float32))
    assert log.groups["slow"].rate_hz == pytest.approx(10.0)
    assert log.facts["start_time"] == "2024-05-01T12:00:00"
    assert log.facts["notes"] == ["group 'notes' was left out: it has no time column"]
    head = read_header(tmp_path / "x.tdms")
    assert head.signals == log.signals
    assert head.facts["rows"] == {"fast": N, "slow": N}


def test_rate_by_map(tmp_path: Path) -> None:
    with nptdms.TdmsWriter(tmp_path / "x.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("g", "a", np.arange(5.0))])
    with pytest.raises(LogError, match=r"no time column.*\[time\] rate"):
        read_log(tmp_path / "x.tdms")
    log = read_log(tmp_path / "x.tdms", NameMap(time=TimeMap(rate=10.0)))
    assert log.groups["g"].frame.rows()[1] == (0.1, 1.0)


def test_a_cut_is_told_and_gives_a_part(tmp_path: Path) -> None:
    good, cut = write(tmp_path / "x.tdms", 10).read_bytes(), tmp_path / "cut.tdms"
    heights = set()
    for part in range(1, 20):
        cut.write_bytes(good[: len(good) * part // 20])
        try:
            log = read_log(cut)
        except LogError as error:
            assert "cut.tdms" in str(error)  # noqa: PT017 - whether it is raised depends on the cut
            continue
        assert "breaks off" in log.facts["salvaged"][0]
        got = log.values("p_Bst")
        np.testing.assert_allclose(got, VALUES[: len(got)] * 100.0)
        heights.add(len(got))
    assert len(heights) > 5


@pytest.mark.parametrize("content", [b"TDSm", b"TDSm" + bytes(24), b"TDSm" + b"\xff" * 60])
def test_damaged(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.tdms").write_bytes(content)
    with pytest.raises(LogError, match=r"x\.tdms: (damaged|no )"):
        read_log(tmp_path / "x.tdms")
