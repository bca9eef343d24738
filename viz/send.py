"""Columns into a Rerun recording: the one place that knows the timeline's name and the slice size."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from viz.colours import DIM, Colour
from viz.series import Array

TIMELINE = "time"
ROWS = 8192  # one chunk; larger and smaller ones load and write more slowly


def entity(*parts: str) -> str:
    """An entity path of ``parts``, whatever characters they hold.

    >>> entity("signals", "50 Hz/a")
    '/signals/50\\\\ Hz\\\\/a'
    """
    return rr.new_entity_path([part or "unnamed" for part in parts])


def times(time: Array) -> list[rr.TimeColumn]:
    """The time column of the one timeline, to the nearest ns (Rerun itself would cut the rest off)."""
    return [rr.TimeColumn(TIMELINE, duration=np.round(time * 1e9).astype("timedelta64[ns]"))]


def lines(
    rec: rr.RecordingStream,
    path: str,
    time: Array,
    values: Array,
    *,
    names: Sequence[str],
    colours: Sequence[Colour],
    stepped: bool = False,
    width: float = 1.2,
) -> None:
    """``values`` of shape (n, k) as k lines of one entity; zoomed out, a pixel shows least and greatest."""
    mode = rr.components.InterpolationMode.StepAfter if stepped else rr.components.InterpolationMode.Linear
    style = rr.SeriesLines(
        names=list(names),
        colors=list(colours),
        widths=[width] * len(names),
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
        interpolation_mode=mode,
    )
    rec.log(path, style, static=True)
    scalars(rec, path, time, values)


def scalars(rec: rr.RecordingStream, path: str, time: Array, values: Array) -> None:
    """More values, shape (n,) or (n, k), of an entity that has its style."""
    for start in range(0, time.size, ROWS):
        part = slice(start, start + ROWS)
        rec.send_columns(path, times(time[part]), rr.Scalars.columns(scalars=values[part]))


VALUES = "signals:values"
"""The component that holds what :func:`rows` sends: a number for each field."""


@dataclass(frozen=True)
class _Rows:
    """What Rerun is to take as it is."""

    values: pa.Array

    def as_arrow_array(self) -> pa.Array:
        return self.values


def rows(rec: rr.RecordingStream, path: str, time: Array, columns: Mapping[str, Array]) -> None:
    """``columns``, each of shape (n,), as fields of one component, whose rows share a time stamp and an id.

    Those make up 24 bytes a row, three times a value: an entity of its own for each signal is that much
    larger. Numbers are kept as they are, in 4 bytes where that is exact.
    """
    arrays = [pa.array(narrow(values)) for values in columns.values()]
    whole = pa.StructArray.from_arrays(arrays, list(columns))
    for start in range(0, time.size, ROWS):
        part = slice(start, start + ROWS)
        rec.send_columns(path, times(time[part]), [rr.ComponentColumn(VALUES, _Rows(whole[part]))])


def narrow(values: Array) -> NDArray[np.floating[Any]]:
    """As float32 where that changes nothing.

    >>> narrow(np.array([0.5, np.nan])).dtype, narrow(np.array([0.1])).dtype
    (dtype('float32'), dtype('float64'))
    """
    with np.errstate(over="ignore"):
        short = values.astype(np.float32)
    return short if np.array_equal(short, values, equal_nan=True) else values


def field_names(names: Sequence[str]) -> list[str]:
    """Names for fields: letters, digits and ``_``, each another one.

    >>> field_names(["p_Int", "truth.p_Int", "truth/p_Int"])
    ['p_Int', 'truth_p_Int', 'truth_p_Int_2']
    """
    found: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = plain if re.match(r"[A-Za-z_]", plain) else f"_{plain}"
        count = 2
        field = plain
        while field in found:
            field, count = f"{plain}_{count}", count + 1
        found.append(field)
    return found


@dataclass(frozen=True, kw_only=True)
class Line:
    """One field of an entity as a line."""

    entity: str
    field: str
    name: str
    colour: Colour

    def visualizer(self) -> Any:
        """How a view is to draw it; zoomed out, a pixel shows least and greatest."""
        mapping = VisualizerComponentMapping(
            target="Scalars:scalars", source_kind=ComponentSourceKind.SourceComponent,
            source_component=VALUES, selector=f".{self.field}",
        )  # fmt: skip
        style = rr.SeriesLines(
            names=self.name, colors=self.colour, widths=1.2,
            aggregation_policy=rr.components.AggregationPolicy.MinMax,
        )  # fmt: skip
        return style.visualizer(mappings=[mapping])


def points(
    rec: rr.RecordingStream, path: str, time: Array, values: Array, *, name: str, colour: Colour, size: float
) -> None:
    """``values`` of shape (n,) as dots."""
    style = rr.SeriesPoints(names=name, colors=colour, markers="circle", marker_sizes=size)
    rec.log(path, style, static=True)
    scalars(rec, path, time, values)


def band(
    rec: rr.RecordingStream,
    path: str,
    time: Array,
    centre: Array,
    half: Array,
    *,
    name: str,
    colour: tuple[int, int, int, int],
) -> None:
    """A shaded band ``centre`` ± ``half`` (shape (n,)) that holds from each time to the next; NaN: none.

    Rerun draws the standard deviation of a measurement, so the half-width goes in as its square.
    """
    style = rr.Measurements.from_fields(
        names=name,
        colors=colour,
        widths=0.0,
        interpolation_mode=rr.components.InterpolationMode.StepAfter,
        aggregation_policy=rr.components.AggregationPolicy.Off,
    )
    rec.log(path, style, static=True)
    for start in range(0, time.size, ROWS):
        part = slice(start, start + ROWS)
        columns = rr.Measurements.columns(values=centre[part], variances=half[part] ** 2)
        rec.send_columns(path, times(time[part]), columns)


def segments(points: Array) -> pa.Array:
    """The line from each of ``points``, shape (n, 2), to the next, as Rerun keeps strips: all at once, since
    one by one takes most of a timeline's time."""
    ends = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
    point = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
    flat = pa.FixedSizeListArray.from_arrays(pa.array(ends.reshape(-1)), type=point)
    offsets = pa.array(np.arange(0, 2 * len(ends) + 1, 2), pa.int32())
    return pa.ListArray.from_arrays(offsets, flat, type=pa.list_(pa.field("item", point, nullable=False)))


def states(
    rec: rr.RecordingStream, path: str, time: Array, names: Sequence[str], palette: dict[str, Colour]
) -> None:
    """A lane whose state at each time is ``names``; an empty name ends a state."""
    known = sorted({name for name in names if name})
    palette_of(rec, path, {name: palette.get(name, DIM) for name in known})
    for start in range(0, time.size, ROWS):
        part = slice(start, start + ROWS)
        rec.send_columns(path, times(time[part]), rr.StateChange.columns(state=list(names[part])))


def palette_of(rec: rr.RecordingStream, path: str, colours: dict[str, Colour]) -> None:
    """The states that a lane knows, with their colours."""
    known = list(colours)
    rgba = [(*colour, 255) for colour in colours.values()]
    rec.log(path, rr.StateConfiguration(values=known, labels=known, colors=rgba), static=True)


def markdown(rec: rr.RecordingStream, path: str, text: str) -> None:
    """A document that is always shown."""
    rec.log(path, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def flat(values: NDArray[np.floating]) -> Array:
    """``values`` as contiguous float64."""
    return np.ascontiguousarray(values, dtype=np.float64)
