"""What is in the recording of a run equals what went in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from recordings import frames, lane, series, signal, verify
from rerun.chunk import RrdReader

from ingest.log import Log
from stages.results import Diagnosis
from viz.lanes import diagnosed
from viz.series import gap_rows
from viz.timeline import write_timeline


@pytest.fixture(scope="module")
def recording(diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "timeline.rrd"
    write_timeline(diagnosis, path)
    return path


@pytest.fixture(scope="module")
def found(recording: Path) -> dict[str, pl.DataFrame]:
    return frames(recording)


def test_rerun_finds_the_recording_sound(recording: Path) -> None:
    assert verify(recording) == 0
    assert [p.name for p in recording.parent.iterdir()] == ["timeline.rrd"]


def test_recordings_of_one_run_are_equal_by_content(
    recording: Path, found: dict[str, pl.DataFrame], diagnosis: Diagnosis, tmp_path: Path
) -> None:
    write_timeline(diagnosis, tmp_path / "again.rrd")
    again = frames(tmp_path / "again.rrd")
    assert again.keys() == found.keys()
    for key, frame in found.items():
        assert str(again[key].to_dict(as_series=False)) == str(frame.to_dict(as_series=False)), key
    ids = [RrdReader(path).recordings()[0].recording_id for path in (recording, tmp_path / "again.rrd")]
    assert ids[0] == ids[1]


def test_signals_keep_every_value_at_its_time(found: dict[str, pl.DataFrame], log: Log) -> None:
    frame = log.groups["fast"].frame
    for name in ("p_Bst", "p_Int", "p_Amb"):
        time, values = signal(found, "fast", name)
        kept = ~np.isnan(values)
        assert (values[kept] == frame[name].to_numpy()).all()
        assert np.abs(time[kept] - frame["time"].to_numpy()).max() <= 5.1e-10


def test_gaps_stay_gaps(found: dict[str, pl.DataFrame], log: Log, diagnosis: Diagnosis) -> None:
    raw = log.groups["fast"].time
    row = int(gap_rows(raw)[0])
    lines = {
        k: series(found, f"{k} Scalars:scalars")
        for k in ("/residuals/r_dp/value", "/probability/leading", "/evidence/leading")
    }
    for key, (time, values) in {**lines, "n_Eng": signal(found, "fast", "n_Eng")}.items():
        inside = (time > raw[row]) & (time < raw[row + 1])
        assert inside.sum() == 1, key
        assert np.isnan(values[inside]).all(), key
    for path in ("/alarm", "/regime", "/fault_diagnosed"):
        assert any(raw[row] < t < raw[row + 1] and state == "" for t, state in lane(found, path))


def test_residuals_and_exceedances_equal_the_samples(
    found: dict[str, pl.DataFrame], diagnosis: Diagnosis
) -> None:
    samples = diagnosis.samples
    for name in ("r_cyl", "r_dp"):
        _, values = series(found, f"/residuals/{name}/value Scalars:scalars")
        assert (values[~np.isnan(values)] == samples[f"residual.{name}"].to_numpy()).all()
        time, red = series(found, f"/residuals/{name}/exceedances Scalars:scalars")
        beyond = samples.filter(pl.col(f"z.{name}").abs() > 3)
        assert (red.ravel() == beyond[f"residual.{name}"].to_numpy()).all()
        assert np.abs(time - beyond["time"].to_numpy()).max() <= 5.1e-10


def test_the_band_follows_sigma(found: dict[str, pl.DataFrame], diagnosis: Diagnosis) -> None:
    samples = diagnosis.samples
    time, variance = series(found, "/residuals/r_dp/band Measurements:variances")
    _, centre = series(found, "/residuals/r_dp/band Measurements:values")
    row = np.searchsorted(time + 1e-9, samples["time"].to_numpy() + 2e-9) - 1
    assert np.sqrt(variance[row, 0]) == pytest.approx(3 * samples["sigma.r_dp"].to_numpy(), rel=0.01)
    assert np.abs(centre[row, 0]).max() < 1e-9
    assert time.size < samples.height / 4


def test_lanes_say_what_the_samples_say(found: dict[str, pl.DataFrame], diagnosis: Diagnosis) -> None:
    samples = diagnosis.samples
    time = samples["time"].to_numpy()
    expected = {
        "/fault_diagnosed": diagnosed(samples).tolist(),
        "/alarm": ["alarm" if d else "no alarm" for d in samples["detection"]],
        "/regime": [f"R{r}" for r in samples["regime"]],
        "/in_domain": ["known" if d else "outside" for d in samples["in_domain"]],
    }
    for path, states in expected.items():
        at, names = zip(*lane(found, path), strict=True)
        row = np.searchsorted(np.array(at), time + 1e-8, side="right") - 1
        assert [names[i] for i in row] == states, path
    assert lane(found, "/fault_injected")[:2] == [(0.0, "none"), (200.0, "boost_leak")]
    assert [state for _, state in lane(found, "/quality")] == [
        "good",
        "spike p_Bst",
        "good",
        "gap",
        "good",
        "",
    ]


def test_probabilities_and_evidence_equal_the_samples(
    found: dict[str, pl.DataFrame], diagnosis: Diagnosis
) -> None:
    for path, prefix in (("/probability/leading", "p."), ("/evidence/leading", "evidence.")):
        faults = [name for row in found[f"{path} SeriesLines:names"]["value"].to_list() for name in row]
        _, values = series(found, f"{path} Scalars:scalars")
        kept = values[~np.isnan(values).all(axis=1)]
        expected = diagnosis.samples.select(f"{prefix}{fault}" for fault in faults).to_numpy()
        assert (kept == expected).all()
        assert faults[-1] == "boost_leak"


def test_windows_stand_where_the_fault_was(found: dict[str, pl.DataFrame], diagnosis: Diagnosis) -> None:
    end = float(diagnosis.samples["time"].max())  # type: ignore[arg-type]
    time, values = series(found, "/residuals/r_cyl/injected Measurements:values")
    assert time == pytest.approx([200.0, end])
    assert np.isnan(values.ravel()).tolist() == [False, True]
    time, _ = series(found, "/residuals/r_cyl/detected Measurements:values")
    assert time == pytest.approx([206.0, end])


def test_the_cursor_point_is_where_the_system_was(
    found: dict[str, pl.DataFrame], diagnosis: Diagnosis
) -> None:
    time, at = series(found, "/map/now Points2D:positions")
    plane = diagnosis.operating_map
    assert plane is not None
    row = np.searchsorted(diagnosis.samples["time"].to_numpy(), time - 1e-6)
    for axis, values in ((0, plane.x), (1, -plane.y)):
        slope, offset = np.polyfit(values[row], at[:, 0, axis], 1)
        assert np.abs(slope * values[row] + offset - at[:, 0, axis]).max() < 1e-3  # float32 on 100 units


def test_two_writes_say_the_same(
    diagnosis: Diagnosis, found: dict[str, pl.DataFrame], tmp_path: Path
) -> None:
    write_timeline(diagnosis, tmp_path / "again.rrd")
    again = frames(tmp_path / "again.rrd")
    ours = {k for k in found if not k.startswith(("/__properties", "/view", "/container", "/viewport"))}
    assert ours == {
        k for k in again if not k.startswith(("/__properties", "/view", "/container", "/viewport"))
    }
    for key in ours:
        assert found[key].equals(again[key]), key


def test_without_regimes_map_or_hypotheses_there_is_still_a_timeline(
    diagnosis: Diagnosis, tmp_path: Path
) -> None:
    samples = diagnosis.samples.select("time", "detection", pl.col("residual.r_dp").alias("indicator.k"))
    samples = samples.with_columns((pl.col("indicator.k") - 2.0).alias("z.k"), pl.lit(1.0).alias("sigma.k"))
    bare = replace(diagnosis, samples=samples, operating_map=None, units={})
    write_timeline(bare, tmp_path / "bare.rrd")
    found = frames(tmp_path / "bare.rrd")
    _, centre = series(found, "/residuals/k/band Measurements:values")
    assert np.nanmax(np.abs(centre - 2.0)) <= 0.01
    assert not any(key.startswith(("/map", "/som", "/regime", "/probability")) for key in found)
    assert {state for _, state in lane(found, "/fault_diagnosed")} == {"none", "unknown", ""}


def test_missing_values_leave_the_rest(diagnosis: Diagnosis, tmp_path: Path) -> None:
    holes = pl.when(pl.int_range(pl.len()) % 7 == 0).then(None)
    names = [c for c in diagnosis.samples.columns if c != "time" and c != "detection"]
    samples = diagnosis.samples.with_columns(holes.otherwise(pl.col(c)).alias(c) for c in names)
    write_timeline(replace(diagnosis, samples=samples), tmp_path / "holes.rrd")
    assert verify(tmp_path / "holes.rrd") == 0
    empty = replace(
        diagnosis, samples=samples.with_columns(pl.lit(None, pl.Float64).alias(c) for c in names if "." in c)
    )
    write_timeline(empty, tmp_path / "empty.rrd")
    assert verify(tmp_path / "empty.rrd") == 0
