from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from ingest.errors import LogError
from stages.results import Diagnosis
from viz.layers import write_layer
from viz.timeline import write_timeline
from viz.viewer import executable, merge


@pytest.fixture(scope="module")
def base(diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("base") / "timeline.rrd"
    write_timeline(diagnosis, path)
    return path


def test_a_layer_becomes_part_of_the_recording(base: Path, diagnosis: Diagnosis, tmp_path: Path) -> None:
    before = base.read_bytes()
    layer, both = tmp_path / "layer.rrd", tmp_path / "both.rrd"
    write_layer(diagnosis, base, layer, "challenger")
    assert base.read_bytes() == before
    assert layer.stat().st_size < 0.3 * base.stat().st_size
    verified = subprocess.run(
        [str(executable()), "rrd", "verify", str(layer)], capture_output=True, check=False
    )
    assert verified.returncode == 0
    merge([base, layer], both)
    (recording,) = RrdReader(both).recordings()
    (own,) = RrdReader(base).recordings()
    assert recording.recording_id == own.recording_id
    drawn = [
        np.array(chunk.to_record_batch()["Scalars:scalars"].to_pylist(), dtype=float).ravel()
        for chunk in RrdReader(both).stream().filter(content="/layers/residuals/r_dp/challenger")
        if not chunk.is_static
    ]
    values = np.concatenate(drawn)
    expected = diagnosis.samples["residual.r_dp"].to_numpy()
    assert np.sort(values[np.isfinite(values)]).tolist() == np.sort(expected).tolist()


def test_what_is_no_recording_is_named(diagnosis: Diagnosis, base: Path, tmp_path: Path) -> None:
    (tmp_path / "x.rrd").write_bytes(b"nothing")
    with pytest.raises(LogError, match=r"x\.rrd is not the recording of one run"):
        write_layer(diagnosis, tmp_path / "x.rrd", tmp_path / "layer.rrd", "a")
    with pytest.raises(LogError, match="there is no folder"):
        write_layer(replace(diagnosis), base, tmp_path / "no" / "layer.rrd", "a")
