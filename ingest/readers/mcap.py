"""MCAP: one protobuf channel per raster, one message per row; events as JSON on ``/events``.

Written by us, a file keeps a log exactly: what is known of the signals is in the metadata of the channels
(:mod:`ingest.mcap_groups`); name, order of groups and facts are in the metadata record ``dynoscope``, with a
checksum. Log times are ns on the log's own clock, shifted where that begins before 0; the exact time is the
field ``time``.

Files of others: each protobuf or JSON channel becomes a group, its nested fields joined by dots.
"""

from __future__ import annotations

import heapq
import json
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from ingest.about import about_json, parse_about, with_flags
from ingest.blocks import BLOCK_BYTES
from ingest.clock import iso
from ingest.errors import LogError
from ingest.log import Event, Group, Log
from ingest.maps import NameMap
from ingest.mcap_groups import OWN, Part, Row, channel_of, layout_of, own_group, their_groups
from ingest.mcap_messages import Decoder, decoder
from ingest.mcap_reader import DAMAGE, McapFile, chunks, define, open_mcap, records
from ingest.mcap_rows import Layout, field_names, join
from ingest.mcap_writer import McapWriter
from ingest.readers import Recording

_ABOUT = "dynoscope"
_LATEST = 1.8e10  # s; later ones do not fit into a log time
_EPOCH = 10**17  # ns; log times beyond are dates
_WORDS, _NUMBERS = ("kind", "channel", "source", "unit"), ("t_start", "t_end", "confidence", "magnitude")
_EVENT_SCHEMA = json.dumps(
    {
        "type": "object",
        "properties": {k: {"type": ["string", "null"]} for k in _WORDS}
        | {k: {"type": ["number", "null"]} for k in _NUMBERS},
    }
).encode()


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins with MCAP's magic."""
    return head.startswith(MCAP0_MAGIC)


def header(path: Path, names: NameMap) -> Recording:
    """Channels, from the summary and as many chunks as it takes to see a message of each."""
    file = open_mcap(path)
    log, ours, _ = _log(path, file, _collect(file, until_all_seen=True), names)
    groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in log.groups.items()}
    facts = dict(log.facts)
    if file.statistics:
        counts = file.statistics.channel_message_counts
        facts["rows"] = {_name(c): counts.get(i, 0) for i, c in file.channels.items() if not _is_events(c)}
    return Recording(Log(log.name, groups, log.events, facts), ours)


def read(path: Path, names: NameMap) -> Recording:
    """All rows. What was lost to damage is told in the fact ``salvaged``.

    Raises:
        LogError: nothing in the file can be read.
    """
    file = open_mcap(path)
    parts = _collect(file)
    counted = sum(part.rows for channel in parts.values() for part in channel)
    if not parts and file.problems:
        raise LogError(f"{path}: nothing can be read: {'; '.join(file.problems)}")
    return _told(file, _log(path, file, parts, names), counted)


def _told(file: McapFile, found: Recording, counted: int) -> Recording:
    """What was found, with what was lost as the fact ``salvaged``."""
    if file.statistics and not file.problems and counted != file.statistics.message_count:
        file.problems.append(f"{counted} of {file.statistics.message_count} messages were found")
    facts = {**found.log.facts, **({"salvaged": file.problems} if file.problems else {})}
    return found._replace(log=replace(found.log, facts=facts))


def blocks(path: Path, names: NameMap) -> Iterator[Recording]:
    """Parts of about :data:`BLOCK_BYTES`, the events in the last; a file of others comes as one."""
    file = open_mcap(path)
    if len(file.data) <= BLOCK_BYTES or not _about(path, file):
        yield read(path, names)
        return
    parts: dict[int, list[Part]] = defaultdict(list)
    layouts: dict[int, Layout | None] = {}
    events: dict[int, list[Part]] = {}
    size = done = counted = 0
    for content in chunks(file):
        _take(file, content, layouts, parts)
        size, done = size + len(content), done + 1
        if size < BLOCK_BYTES and done < len(file.spans):
            continue
        for number in [n for n in parts if n in file.channels and _is_events(file.channels[n])]:
            events.setdefault(number, []).extend(parts.pop(number))
        counted += sum(part.rows for channel in parts.values() for part in channel)
        yield _log(path, file, parts, names)._replace(share=done / len(file.spans))
        parts.clear()
        size = 0
    counted += sum(part.rows for channel in events.values() for part in channel)
    if not counted and file.problems:
        raise LogError(f"{path}: nothing can be read: {'; '.join(file.problems)}")
    yield _told(file, _log(path, file, events, names), counted)


def _collect(file: McapFile, *, until_all_seen: bool = False) -> dict[int, list[Part]]:
    """The rows of each channel in order of the file."""
    counts = file.statistics.channel_message_counts if file.statistics else {}
    wanted = {number for number, count in counts.items() if count}
    parts: dict[int, list[Part]] = defaultdict(list)
    layouts: dict[int, Layout | None] = {}
    for content in chunks(file):
        _take(file, content, layouts, parts)
        if until_all_seen and wanted <= set(parts):
            break
    return parts


def _take(
    file: McapFile, content: memoryview, layouts: dict[int, Layout | None], parts: dict[int, list[Part]]
) -> None:
    """Adds a chunk's rows to ``parts``; damage is noted."""
    try:
        _split(file, content, layouts, parts)
    except DAMAGE as error:
        file.problems.append(f"the records of a chunk are damaged ({error}); rows are lost")


def _split(
    file: McapFile, content: memoryview, layouts: dict[int, Layout | None], parts: dict[int, list[Part]]
) -> None:
    """Adds a chunk's rows to ``parts``: all at once if they are of one channel and layout of ours."""
    fresh: dict[int, Part] = {}
    for opcode, first, end in records(content, 0, len(content)):
        if opcode != Opcode.MESSAGE:
            define(file, opcode, content[first:end])
            continue
        number = int.from_bytes(content[first : first + 2], "little")
        if number not in layouts and number in file.channels:
            layouts[number] = layout_of(file.channels[number], file.schemas)
        layout = layouts.get(number)
        columns = layout.decode(content[first - 9 :]) if layout and not fresh else None
        if columns is not None:
            parts[number].append(Part(columns=columns))
            return
        log_time = int.from_bytes(content[first + 6 : first + 14], "little")
        fresh.setdefault(number, Part()).messages.append((log_time, bytes(content[first + 22 : end])))
    for number, part in fresh.items():
        parts[number].append(part)


def _is_events(channel: Channel) -> bool:
    return channel.metadata.get(OWN) == "events"


def _name(channel: Channel) -> str:
    return channel.metadata.get("group") or channel.topic.strip("/") or f"channel_{channel.id}"


def _log(path: Path, file: McapFile, parts: dict[int, list[Part]], names: NameMap) -> Recording:
    about = _about(path, file)
    groups: dict[str, Group] = {}
    events: list[Event] = []
    theirs: dict[str, list[Row]] = {}
    notes = []
    for number, channel in file.channels.items():
        mine = parts.get(number, [])
        try:
            decode = decoder(channel, file.schemas.get(channel.schema_id))
            if layout := layout_of(channel, file.schemas):
                group = own_group(channel, layout, mine, decode)
                known = with_flags(group.signals, about) if about else group.signals
                groups[_name(channel)] = replace(group, signals=known)
                continue
            rows = _decoded(channel, mine, decode, file.problems)
        except LogError as error:
            notes.append(str(error))
            continue
        if _is_events(channel):
            events += [Event(**row) for _, row in rows]
        else:
            theirs.setdefault(_name(channel), []).extend(rows)
    foreign, start = their_groups(str(path), theirs, names.time)
    groups |= foreign
    if not groups and not about:
        raise LogError(f"{path}: no channel can be read: {'; '.join(notes) or 'there are none'}")
    facts = dict(about.get("facts", {}))
    facts |= {"start_time": iso(start)} if start > _EPOCH else {}
    facts |= {"notes": notes} if notes else {}
    order = [g for g in about.get("groups", ()) if g in groups]
    groups = {k: groups[k] for k in dict.fromkeys([*order, *groups])}
    if about and len(events) == len(about["events"]):  # they stand in the file in order of their time
        events = [event for _, event in sorted(zip(about["events"], events, strict=True), key=itemgetter(0))]
    return Recording(Log(about.get("name", path.stem), groups, tuple(events), facts), ours=bool(about))


def _decoded(channel: Channel, parts: list[Part], decode: Decoder, problems: list[str]) -> list[Row]:
    """Rows of a channel without those that cannot be decoded, unless none can."""
    rows: list[Row] = []
    errors: list[LogError] = []
    for log_time, data in (message for part in parts for message in part.messages):
        try:
            rows.append((log_time, decode(data)))
        except LogError as error:
            errors.append(error)
    if errors and not rows:
        raise errors[0]
    if errors:
        problems.append(f"{len(errors)} messages of channel {channel.topic} are lost: {errors[0]}")
    return rows


def _about(path: Path, file: McapFile) -> dict[str, Any]:
    """What the :class:`Recorder` noted last; empty if the file is not ours or the notes are damaged."""
    for age, record in enumerate(r for r in reversed(file.metadata) if r.name == _ABOUT):
        text = record.metadata.get("log", "")
        if record.metadata.get("crc32") == str(zlib.crc32(text.encode())):
            if age:
                file.problems.append("what was noted at the end of the log is damaged")
            return parse_about(str(path), text)
    if any(OWN in channel.metadata for channel in file.channels.values()):
        file.problems.append("name and facts of the log are missing or damaged")
    return {}


class Recorder:
    """Writes a log part by part: a channel for each group and one for the events, in chunks of about 1 MiB.

    Log times count from the log's own 0, or from the start of the first part where that is earlier.
    """

    def __init__(self, path: Path, first: Log) -> None:
        messages = field_names(first.groups)
        made = [
            channel_of(g, i, m)
            for i, (g, m) in enumerate(zip(first.groups.values(), messages, strict=True), 1)
        ]
        self.layouts = {g: layout for g, (_, _, layout) in zip(first.groups, made, strict=True)}
        self.events = len(made) + 1
        schemas = [
            *(s for s, _, _ in made),
            Schema(self.events, _EVENT_SCHEMA, "jsonschema", "dynoscope.Event"),
        ]
        channels = [
            *(c for _, c, _ in made),
            Channel(self.events, "/events", "json", {OWN: "events"}, self.events),
        ]
        earliest = [float(g.time.min()) for g in first.groups.values() if g.frame.height]
        self.shift = -min(0.0, *earliest, *(e.t_start for e in first.events), 0.0)
        self.counts = dict.fromkeys(first.groups, 0)
        self.stream = path.open("wb")
        self.writer = McapWriter(self.stream, schemas, channels)
        self._describe(first, [])  # for a file that is cut

    def add(self, part: Log) -> None:
        """Writes the rows of ``part``.

        Raises:
            LogError: a time stamp is beyond what a log time holds.
        """
        batches = []
        for name, group in part.groups.items():
            stamps = self._log_times(part.name, group.time)
            batches.append(self.layouts[name].encode(group.frame.get_columns(), stamps, self.counts[name]))
            self.counts[name] += group.frame.height
        self.writer.add(heapq.merge(*batches, key=lambda b: int(b.log_time[0])))

    def finish(self, whole: Log, attachments: Mapping[str, bytes]) -> None:
        """Writes events, attachments and what is known of the whole."""
        order = sorted(range(len(whole.events)), key=lambda i: whole.events[i].t_start)
        events = [whole.events[i] for i in order]
        stamps = self._log_times(whole.name, np.array([e.t_start for e in events], np.float64))
        self.writer.add(join(self.events, (json.dumps(e.to_json()).encode() for e in events), stamps))
        self._describe(whole, order)
        for name, content in attachments.items():
            self.writer.add_attachment(name, content)
        self.writer.finish()
        self.close()

    def close(self) -> None:
        self.stream.close()

    def _describe(self, log: Log, order: list[int]) -> None:
        text = about_json(log, self.counts, events=order)
        self.writer.add_metadata(_ABOUT, {"log": text, "crc32": str(zlib.crc32(text.encode()))})

    def _log_times(self, log: str, time: NDArray[np.float64]) -> NDArray[np.uint64]:
        latest = float(np.abs(time).max()) if len(time) else 0.0
        if not latest + self.shift < _LATEST:
            raise LogError(f"log {log!r}: time stamps reach {latest:g} s; are they in s?")
        return np.rint(np.maximum(time + self.shift, 0.0) * 1e9).astype(np.uint64)
