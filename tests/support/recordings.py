"""What is in a recording, read back with Rerun's own reader."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from viz.send import VALUES
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


def static(path: Path) -> dict[str, list[object]]:
    """Every static component of a recording, by entity and component."""
    found = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                found[f"{chunk.entity_path} {name}"] = batch[name].to_pylist()[0]
    return found


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


def verify(path: Path) -> int:
    return subprocess.run(
        [str(executable()), "rrd", "verify", str(path)], capture_output=True, check=False
    ).returncode
