"""Groups as MCAP channels, and back.

The metadata of a channel of ours hold ``<key>.<field>`` for each protobuf field: ``unit``, ``source_name``
... as in :meth:`ingest.log.Signal.to_metadata`, ``dtype``, and ``name`` where that is no protobuf identifier.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl
from mcap.records import Channel, Schema

from ingest.clock import Clock
from ingest.log import TIME, Group, Signal
from ingest.maps import TimeMap, match
from ingest.mcap_messages import Decoder
from ingest.mcap_rows import Column, Layout, field_names, field_type

OWN = "dynoscope"
Row = tuple[int, Mapping[str, Any]]
"""Log time in ns, and values by field."""


@dataclass
class Part:
    """Consecutive rows of a channel: as columns, or as messages with their log times."""

    columns: dict[str, Column] = field(default_factory=dict)
    messages: list[tuple[int, bytes]] = field(default_factory=list)

    @property
    def rows(self) -> int:
        return len(self.columns.get(TIME, self.messages))


def channel_of(group: Group, number: int, message: str) -> tuple[Schema, Channel, Layout]:
    """Schema, channel and layout of a group; ``message`` is the protobuf name of its rows."""
    columns = group.frame.get_columns()
    fields = dict(zip(field_names(c.name for c in columns), columns, strict=True))
    metadata = {OWN: "group", "group": group.name}
    for name, column in fields.items():
        about = {"dtype": str(column.dtype)} | ({"name": column.name} if column.name != name else {})
        if column.name != TIME:
            about |= group.signals[column.name].to_metadata()
        metadata |= {f"{key}.{name}": value for key, value in about.items()}
    layout = Layout(number, f"dynoscope.{message}", {f: field_type(c.dtype) for f, c in fields.items()})
    schema = Schema(id=number, name=layout.message, encoding="protobuf", data=layout.descriptor())
    return schema, Channel(number, f"/{group.name}", "protobuf", metadata, number), layout


def layout_of(channel: Channel, schemas: Mapping[int, Schema]) -> Layout | None:
    """The layout of a channel that :func:`channel_of` made, None for others."""
    if channel.metadata.get(OWN) != "group" or channel.schema_id not in schemas:
        return None
    schema = schemas[channel.schema_id]
    return Layout.from_descriptor(channel.id, schema.name, schema.data)


def own_group(channel: Channel, layout: Layout, parts: Sequence[Part], decode: Decoder) -> Group:
    """The group that :func:`channel_of` made a channel of."""
    tables = [p.columns or layout.rows([decode(data) for _, data in p.messages]) for p in parts]
    raw = layout.columns(tables)
    about: dict[str, dict[str, str]] = defaultdict(dict)
    for key, value in channel.metadata.items():
        what, _, of = key.partition(".")
        about[of][what] = value
    columns = []
    for name in layout.fields:
        values, dtype = raw[name], getattr(pl, about[name]["dtype"])
        if values.dtype != dtype:
            values = (values.fill_nan(None) if values.dtype.is_float() else values).cast(dtype)
        columns.append(values.alias(about[name].get("name", name)))
    signals = [Signal.from_metadata(c.name, about[f]) for f, c in zip(layout.fields, columns, strict=True)]
    named = {s.name: s for s in signals if s.name != TIME}
    return Group(channel.metadata["group"], pl.DataFrame(columns), named)


def their_groups(
    where: str, rows: Mapping[str, Sequence[Row]], time: TimeMap
) -> tuple[dict[str, Group], int]:
    """Groups of channels that others wrote, and the log time in ns from which their time counts.

    A field that several channels have is named ``<channel>.<field>``. Time is the log time, counted from the
    first message of all, unless the map names a field.
    """
    start = min((t for channel in rows.values() for t, _ in channel), default=0)
    fields = {n: list(dict.fromkeys(f for _, row in channel for f in row)) for n, channel in rows.items()}
    shared = Counter(f for names in fields.values() for f in names) + Counter([TIME])
    groups = {}
    for name, channel in rows.items():
        values = [pl.Series(f, [row.get(f) for _, row in channel], strict=False) for f in fields[name]]
        frame = pl.DataFrame(values)
        chosen = match(time.source, frame.columns)
        if chosen:
            frame = Clock(where, None, time).timed(frame, chosen[0])
        several = [f for f in frame.columns if shared[f] > 1 and not (chosen and f == TIME)]
        frame = frame.rename({f: f"{name}.{f}" for f in several})
        if not chosen:
            stamps = np.array([t for t, _ in channel], np.uint64) - np.uint64(start)
            frame = frame.with_columns(pl.Series(TIME, stamps.astype(np.float64) / 1e9))
        groups[name] = Group(name, frame)
    return groups, start
