from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from ingest.log import Log
from stages.results import Diagnosis, OperatingMap
from viz.live import Live


def part_of(plane: OperatingMap, rows: slice) -> OperatingMap:
    return OperatingMap(**{**vars(plane), "x": plane.x[rows], "y": plane.y[rows]})


@pytest.fixture(scope="module")
def found(
    log: Log, diagnosis: Diagnosis, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, pl.DataFrame]:
    """What a live recording of the made-up run holds, made in steps of 7 s."""
    path = tmp_path_factory.mktemp("live") / "live.rrd"
    rec = rr.RecordingStream("dynoscope live", send_properties=False)
    rec.set_log_time_enabled(False)
    rec.save(path)
    samples, plane = diagnosis.samples, diagnosis.operating_map
    assert plane is not None
    live = Live(rec, log, samples.head(0), plane)
    for start in np.arange(0.0, 600.0, 7.0):
        part = log.between(start, start + 7.0)
        rows = (samples["time"] >= start) & (samples["time"] < start + 7.0)
        at = np.flatnonzero(rows.to_numpy())
        where = slice(at[0], at[-1] + 1) if at.size else slice(0, 0)
        live.step(part, samples.filter(rows), part_of(plane, where))
    live.step(None, samples.head(0), part_of(plane, slice(0, 0)))
    live.end(diagnosis)
    rec.disconnect()
    parts: dict[str, list[pl.DataFrame]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if not chunk.is_static and ":" in name and "time" in batch.schema.names:
                time = pl.Series(pl.from_arrow(batch["time"])).cast(pl.Int64) / 1e9
                value = pl.Series([v[0] if v else None for v in batch[name].to_pylist()], strict=False)
                frame = pl.DataFrame({"time": time, "value": value})
                parts.setdefault(f"{chunk.entity_path} {name}", []).append(frame)
    return {k: pl.concat(v).sort("time", maintain_order=True) for k, v in parts.items()}


def test_every_value_arrives(found: dict[str, pl.DataFrame], diagnosis: Diagnosis, log: Log) -> None:
    samples = diagnosis.samples
    for key, expected in {
        "/z/r_dp": samples["z.r_dp"].clip(-10.0, 10.0),
        "/probability/boost_leak": samples["p.boost_leak"].cast(pl.Float64),
        "/evidence/maf_gain": samples["evidence.maf_gain"].cast(pl.Float64),
        "/signals/n_Eng": log.groups["fast"].frame["n_Eng"],
    }.items():
        values = found[f"{key} Scalars:scalars"]["value"].drop_nans()
        assert values.to_numpy() == pytest.approx(expected.to_numpy(), abs=0), key


def test_lanes_change_when_the_states_do(found: dict[str, pl.DataFrame]) -> None:
    alarm = found["/alarm StateChange:state"]
    assert alarm["value"].to_list() == ["no alarm", "alarm"]
    assert alarm["time"][1] == pytest.approx(206.0)
    injected = found["/fault_injected StateChange:state"]
    assert injected["value"].to_list() == ["none", "boost_leak"]
    assert injected["time"][1] == pytest.approx(200.0)


def test_the_words_say_what_holds(found: dict[str, pl.DataFrame]) -> None:
    words = found["/summary TextDocument:text"]
    assert str(words["value"][0]).startswith("## No alarm")
    alarms = words.filter(pl.col("value").str.contains("ALARM"))
    assert alarms["time"][0] == pytest.approx(206.0)
    assert "Against the truth" in str(words["value"][-1])


def test_nothing_stands_ahead_of_its_time(found: dict[str, pl.DataFrame]) -> None:
    for key, frame in found.items():
        assert frame["time"].max() <= 600.0, key  # type: ignore[operator]


def test_the_point_on_the_map_moves(found: dict[str, pl.DataFrame]) -> None:
    assert found["/map/now Points2D:positions"].height > 2000
