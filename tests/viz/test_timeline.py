"""What is in the recording equals what went in, read back with Rerun's own reader."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from ingest.errors import LogError
from ingest.log import Event, Group, Log, Signal
from stages.results import Diagnosis
from viz import signals
from viz.lanes import diagnosed
from viz.send import VALUES
from viz.series import gap_rows
from viz.timeline import write_log_timeline, write_timeline
from viz.viewer import executable

Array = NDArray[np.float64]


def frames(path: Path) -> dict[str, pl.DataFrame]:
    """Every (entity, component) of a recording as ``time, value`` in order of time; static ones have none."""
    parts: dict[str, list[pl.DataFrame]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if ":" not in name:
                continue
            data = {"value": pl.Series(batch[name].to_pylist(), strict=False)}
            if not chunk.is_static:
                data = {"time": pl.from_arrow(batch["time"]), **data}  # type: ignore[dict-item]
            parts.setdefault(f"{chunk.entity_path} {name}", []).append(pl.DataFrame(data))
    return {
        k: pl.concat(v).sort("time") if "time" in v[0].columns else pl.concat(v) for k, v in parts.items()
    }


def series(found: dict[str, pl.DataFrame], key: str) -> tuple[Array, Array]:
    """Times in s, shape (n,), and numbers, shape (n, k)."""
    frame = found[key]
    seconds = frame["time"].cast(pl.Int64).to_numpy() / 1e9
    return seconds, np.array(frame["value"].to_list(), dtype=float)


def signal(found: dict[str, pl.DataFrame], group: str, field: str) -> tuple[Array, Array]:
    """Times in s and values of a signal, both of shape (n,)."""
    frame = found[f"/signals/{group} {VALUES}"]
    seconds = frame["time"].cast(pl.Int64).to_numpy() / 1e9
    return seconds, np.array([row[0][field] for row in frame["value"]], dtype=float)


def drawn_lines(path: Path) -> list[tuple[str, str]]:
    """Field and name of each line of each plot, as the layout has them."""
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    found: dict[str, dict[str, str]] = {}
    for chunk in reader.stream(store=layout):
        batch, entity = chunk.to_record_batch(), str(chunk.entity_path)
        if "/overrides/signals/" in entity:
            told = found.setdefault(entity, {})
            for name in batch.schema.names:
                if name == "SeriesLines:names":
                    told["name"] = batch[name].to_pylist()[0][0]
                if name == "VisualizerInstruction:component_map":
                    told["field"] = batch[name].to_pylist()[0][0]["selector"].removeprefix(".")
    return sorted({(told["field"], told["name"]) for told in found.values() if told})


def titles(path: Path) -> set[str]:
    """The titles of all views."""
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=layout)]
    named = [
        b["ViewBlueprint:display_name"] for b in batches if "ViewBlueprint:display_name" in b.schema.names
    ]
    return {row[0] for column in named for row in column.to_pylist()}


def lane(found: dict[str, pl.DataFrame], path: str) -> list[tuple[float, str]]:
    frame = found[f"{path} StateChange:state"]
    seconds = (frame["time"].cast(pl.Int64) / 1e9).to_list()
    return [(t, v[0]) for t, v in zip(seconds, frame["value"].to_list(), strict=True)]


@pytest.fixture(scope="module")
def recording(diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "timeline.rrd"
    write_timeline(diagnosis, path)
    return path


@pytest.fixture(scope="module")
def found(recording: Path) -> dict[str, pl.DataFrame]:
    return frames(recording)


def verify(path: Path) -> int:
    return subprocess.run(
        [str(executable()), "rrd", "verify", str(path)], capture_output=True, check=False
    ).returncode


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
    assert [state for _, state in lane(found, "/quality")] == ["good", "spike", "good", "gap", "good", ""]


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


def one(frame: dict[str, Any], **log: Any) -> Log:
    return Log(name="l", groups={"g": Group("g", pl.DataFrame(frame))}, **log)


@pytest.mark.parametrize("odd", ["", "/", "a b", "**", "+ /x", "ü°C", "a.b[0]", "\\", "x:y", "-"])
def test_any_name_can_be_shown(odd: str, tmp_path: Path) -> None:
    group = Group(odd, pl.DataFrame({"time": [0.0, 1.0], odd + "v": [1.0, 2.0], odd + "s": ["on", "off"]}))
    path = tmp_path / "odd.rrd"
    write_log_timeline(Log(name=odd, groups={odd: group}), path)
    assert verify(path) == 0
    (drawn,) = drawn_lines(path)
    assert drawn[1] == odd + "v"
    (values,) = (f["value"].to_list() for k, f in frames(path).items() if k.endswith(VALUES))
    assert values == [[{drawn[0]: 1.0}], [{drawn[0]: 2.0}]]


def test_rows_out_of_order_are_shown_in_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    order = rng.permutation(500)
    write_log_timeline(one({"time": order * 0.1, "v": order * 1.0}), tmp_path / "l.rrd")
    time, values = signal(frames(tmp_path / "l.rrd"), "g", "v")
    assert values.ravel().tolist() == list(range(500))
    assert time == pytest.approx(np.arange(500) * 0.1)


def test_long_groups_keep_their_peaks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "BYTES", 60_000)
    monkeypatch.setattr(signals, "ENVELOPE_POINTS", 1000)
    monkeypatch.setattr(signals, "FEWEST", 500)
    values = np.sin(np.arange(20_000) / 50.0)
    values[12_345] = 99.0
    write_log_timeline(one({"time": np.arange(20_000) * 1e-3, "v": values}), tmp_path / "l.rrd")
    found = frames(tmp_path / "l.rrd")
    _, drawn = signal(found, "g", "v")
    assert drawn.size <= 1002
    assert (drawn.max(), drawn.min()) == (99.0, values.min())
    assert "least and greatest" in found["/summary TextDocument:text"]["value"][0][0]


def test_long_groups_keep_every_value_where_it_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "BYTES", 60_000)
    monkeypatch.setattr(signals, "FEWEST", 500)
    rng = np.random.default_rng(5)
    values = rng.normal(size=20_000)
    events = (Event(t_start=7.0, kind="sensor_offset", source="truth"),)
    write_log_timeline(
        one({"time": np.arange(20_000) * 1e-3, "v": values}, events=events), tmp_path / "l.rrd"
    )
    found = frames(tmp_path / "l.rrd")
    time, drawn = signal(found, "g", "v")
    near = np.abs(time - 7.0) < 0.2995
    assert drawn[near].ravel().tolist() == values[6701:7300].tolist()
    assert (np.diff(time) >= 0).all()
    assert (drawn.max(), drawn.min()) == (values.max(), values.min())
    assert drawn.size * (signals.ROW_BYTES + 8) < 1.1 * 60_000
    assert "every value from 6." in found["/summary TextDocument:text"]["value"][0][0]


def test_what_cannot_be_drawn_is_named(tmp_path: Path) -> None:
    write_log_timeline(one({"time": [0.0], "v": [1], "blob": [b"x"]}), tmp_path / "l.rrd")
    text = frames(tmp_path / "l.rrd")["/summary TextDocument:text"]["value"][0][0]
    assert "blob: neither number nor text" in text


def test_events_may_reach_beyond_the_log(tmp_path: Path) -> None:
    events = tuple(
        Event(t_start=a, t_end=b, kind=k, source="truth")
        for a, b, k in ((-5.0, 3.0, "maf_gain"), (2.0, 99.0, "boost_leak"))
    )
    write_log_timeline(one({"time": np.arange(11.0), "v": np.zeros(11)}, events=events), tmp_path / "l.rrd")
    states = lane(frames(tmp_path / "l.rrd"), "/fault_injected")
    assert states == [(0.0, "maf_gain"), (2.0, "boost_leak+maf_gain"), (3.0, "boost_leak"), (10.0, "")]


Write = Callable[[Path], None]


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: write_log_timeline(one({"time": [0.0]}), p / "no" / "l.rrd"), "there is no folder"),
        (lambda p: write_log_timeline(one({"time": [1e12, 2e12]}), p / "l.rrd"), "expected seconds"),
        (lambda p: write_log_timeline(Log(name="l", groups={}), p / "l.rrd"), "no samples"),
    ],
)
def test_mistakes_are_explained_and_leave_nothing(write: Write, message: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=message):
        write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_units_stand_with_their_signals(tmp_path: Path) -> None:
    frame = pl.DataFrame({"time": [0.0, 1.0], "a": [1.0, 2.0], "b": [1.0, 2.0], "c": [1.0, 2.0]})
    given = {
        "a": Signal(name="a", unit="kPa"),
        "b": Signal(name="b", unit="K"),
        "c": Signal(name="c", unit="kPa"),
    }
    write_log_timeline(Log(name="l", groups={"g": Group("g", frame, given)}), tmp_path / "l.rrd")
    assert sorted(title for title in titles(tmp_path / "l.rrd") if "[" in title) == ["a, c [kPa]", "b [K]"]


def test_plots_of_one_signal_share_the_rows_of_their_group(tmp_path: Path) -> None:
    """24 bytes of time and id come with a row; 14 signals of 8 bytes that share it stay near 9 each."""
    rng = np.random.default_rng(7)
    rows, count = 20_000, 14
    values = {f"s{i}": rng.normal(size=rows) for i in range(count)}
    for kind, limit in ((np.float64, 9.1), (np.float32, 5.2)):
        frame = {"time": np.arange(rows) * 0.02, **{n: v.astype(kind) for n, v in values.items()}}
        write_log_timeline(one(frame), tmp_path / "whole.rrd")
        write_log_timeline(one({n: v[:2] for n, v in frame.items()}), tmp_path / "layout.rrd")
        whole, layout = ((tmp_path / f"{n}.rrd").stat().st_size for n in ("whole", "layout"))
        assert (whole - layout) / rows / count < limit
        found = frames(tmp_path / "whole.rrd")
        assert all((signal(found, "g", n)[1] == v.astype(kind)).all() for n, v in values.items())
