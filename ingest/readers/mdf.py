"""MDF 3 and 4 (ASAM), by ``asammdf``: one group per channel group, read by record range.

What dynoscope writes is plain MDF 4.10 with units; what MDF has no place for is in the attachment
``dynoscope.json``.
"""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.about import about_json, parse_about
from ingest.blocks import BLOCK_BYTES, join
from ingest.errors import LogError
from ingest.log import TIME, Event, Group, Log, Signal
from ingest.maps import NameMap
from ingest.mdf_header import ABOUT, plain_recording
from ingest.mdf_samples import cut_blocks, group_name, series_of, signal_of, unique_name
from ingest.readers import Recording, check_declared, need
from ingest.tables import distinct

_TIME_MASTER = 1  # sync type of a time channel
_MASTERS = (2, 3)  # channel types: master, virtual master
_DAMAGE = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    MemoryError,
    RuntimeError,
)


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins as an MDF file, finished or not."""
    return head.startswith((b"MDF  ", b"UnFinMF "))


def header(path: Path, names: NameMap) -> Recording:
    """Channels and row counts; the types are those of the first rows."""
    if (plain := plain_recording(path)) is not None:
        return plain
    with _opened(path, ranges=True) as file:
        found = _Mdf(path, file)
        log = found.part(0, rows=1)
        groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in log.groups.items()}
        counts = dict(zip(found.members, found.counts, strict=True))
        return Recording(
            Log(log.name, groups, log.events, {**found.facts, "rows": counts}), ours=bool(found.about)
        )


def read(path: Path, names: NameMap) -> Recording:
    """All groups with a time channel.

    Raises:
        LogError: damaged so that nothing can be read, or no group has a time channel.
    """
    parts = list(blocks(path, names, None))
    return Recording(join(p.log for p in parts), ours=parts[-1].ours)


def blocks(path: Path, names: NameMap, size: int | None = BLOCK_BYTES) -> Iterator[Recording]:
    """Parts with the same share of every group's rows; the last one has no rows, but all facts."""
    ranges = size is not None and path.stat().st_size > size
    with _opened(path, ranges=ranges) as file:
        found = _Mdf(path, file)
        number = max(1, -(-found.bytes // size)) if size and ranges else 1
        for index in found.members.values() if ranges else ():
            cut_blocks(file.groups[index])
        rows = [-(-n // number) for n in found.counts]
        part = None
        for i in range(number):
            part = found.part(i, rows=rows)
            yield Recording(part, bool(found.about), (i + 1) / number)
        assert part is not None  # there is at least one
        if not any(found.got.values()):
            raise LogError(f"{path}: no samples: {'; '.join(found.problems) or 'every group is empty'}")
        groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in part.groups.items()}
        yield Recording(Log(part.name, groups, part.events, found.facts), ours=bool(found.about))


@contextmanager
def _opened(path: Path, *, ranges: bool = False) -> Iterator[Any]:
    """The open file. Of a stream the library reads ``ranges`` of records; of a path it always reads all."""
    asammdf = need("asammdf", "mdf")
    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # what it has to say, we say with the file's name
    with path.open("rb") as stream:
        with _without_last_words():
            file, problem = _open(asammdf, stream if ranges else path)
            if file is None:
                gc.collect()  # now, so that it is deleted here
        if file is None:
            raise LogError(f"{path}: damaged MDF file: {problem}")
        with closing(file):
            yield file


def _open(asammdf: Any, source: Any) -> tuple[Any, str]:
    try:
        return asammdf.MDF(source), ""
    except OSError:
        raise
    except Exception as error:  # on damage the library raises whatever its parser stumbles over
        return None, str(error) or type(error).__name__


@contextmanager
def _without_last_words() -> Iterator[None]:
    """An ``asammdf.MDF`` that could not be opened complains once more when it is deleted."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = hook


class _Mdf:
    """What an open file holds; ``counts`` rows by group, ``problems`` met while reading."""

    def __init__(self, path: Path, file: Any) -> None:
        self.path, self.file = path, file
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.about = self._about()
        self.members = self._groups()
        if not self.members:
            raise LogError(
                f"{path}: no group has a time channel: {'; '.join(self.notes) or 'there are none'}"
            )
        self.counts = [int(file.groups[i].channel_group.cycles_nr) for i in self.members.values()]
        widths = [file.groups[i].channel_group.samples_byte_nr for i in self.members.values()]
        self.bytes = sum(n * w for n, w in zip(self.counts, widths, strict=True))
        for count, index in zip(self.counts, self.members.values(), strict=True):
            check_declared(path, count, len(file.groups[index].channels))
        self.got = dict.fromkeys(self.members, 0)
        self.broken: set[str] = set()
        self.skipped: set[tuple[int, int]] = set()

    @property
    def facts(self) -> dict[str, Any]:
        facts = dict(self.about.get("facts", {}))
        start = self.file.header.start_time
        if not self.about and start is not None and start.year > 1970:
            facts["start_time"] = start.isoformat()
        return facts | {k: v for k, v in (("notes", self.notes), ("salvaged", self.problems)) if v}

    def part(self, number: int, rows: int | list[int]) -> Log:
        """Rows ``number * rows`` and on of each group."""
        each = rows if isinstance(rows, list) else [rows] * len(self.members)
        found = zip(self.members.items(), each, self.counts, strict=True)
        groups = {k: self._group(k, i, number * n, min(n, total - number * n)) for (k, i), n, total in found}
        events = tuple(Event(**e) for e in self.about.get("events", ()))
        return Log(self.about.get("name", self.path.stem), distinct(groups), events, self.facts)

    def _about(self) -> dict[str, Any]:
        attachments = self.file.attachments if self.file.version >= "4" else ()
        for i, attachment in enumerate(attachments):
            if Path(attachment.file_name).name == ABOUT:
                content, *_ = self.file.extract_attachment(index=i)
                return parse_about(f"{self.path}, attachment {ABOUT}", bytes(content))
        return {}

    def _groups(self) -> dict[str, int]:
        """Name -> index of the groups with a time channel."""
        members: dict[str, int] = {}
        for i, group in enumerate(self.file.groups):
            info = group.channel_group
            name = group_name(i, getattr(info, "acq_name", ""), info.comment, members)
            master = self.file.masters_db.get(i)
            is_time = master is not None and getattr(group.channels[master], "sync_type", 1) == _TIME_MASTER
            if is_time:
                members[name] = i
            elif info.cycles_nr:
                self.notes.append(f"group {name!r} was left out: it has no time channel")
        return members

    def _group(self, name: str, index: int, first: int, count: int) -> Group:
        group = self.file.groups[index]
        master = self.file.masters_db[index]
        wanted = [
            (None, index, j) for j in range(len(group.channels))
            if j != master and (index, j) not in self.skipped
        ]  # fmt: skip
        signals = self._select(name, wanted, index, first, count)
        time = signals[0].timestamps if signals else self._time(index, first, count)
        columns: dict[str, pl.Series] = {TIME: pl.Series(TIME, time, pl.Float64)}
        known: dict[str, Signal] = {}
        for signal, (_, _, j) in zip(signals, wanted, strict=True):
            column = series_of(signal.samples, signal.invalidation_bits)
            if column is None:
                self.skipped.add((index, j))
                self.notes.append(f"channel {signal.name!r} was skipped: its samples are arrays or records")
                continue
            unique = unique_name(signal.name, columns)
            columns[unique] = column
            known[unique] = self._signal(unique, signal, column)
        self.got[name] += len(time)
        return Group(name, pl.DataFrame(columns), known)

    def _select(self, name: str, wanted: list[Any], index: int, first: int, count: int) -> list[Any]:
        if count > 0 and wanted and name not in self.broken:
            try:
                signals = self.file.select(wanted, record_offset=first, record_count=count, copy_master=False)
                if (got := min(len(s.samples) for s in signals)) < count:
                    self._lost(name, index, first + got)
                    signals = [s[:got] for s in signals]
                return list(signals)
            except _DAMAGE:
                self._lost(name, index, first)
        return [_Nothing(self.file.groups[i].channels[j]) for _, i, j in wanted]

    def _time(self, index: int, first: int, count: int) -> NDArray[np.float64]:
        """Time stamps of a group without other channels."""
        return np.asarray(self.file.get_master(index, record_offset=first, record_count=max(count, 0)))

    def _lost(self, name: str, index: int, kept: int) -> None:
        self.broken.add(name)
        total = int(self.file.groups[index].channel_group.cycles_nr)
        self.problems.append(f"group {name!r}: only {kept} of {total} rows could be read")

    def _signal(self, name: str, signal: Any, column: pl.Series) -> Signal:
        if name in (known := self.about.get("signals", {})):
            return Signal.from_metadata(name, known[name])
        return signal_of(name, signal.name, str(signal.unit or ""), str(signal.comment or ""), column.dtype)


class _Nothing:
    """A channel of which no sample could be read."""

    samples = timestamps = np.empty(0)
    invalidation_bits = None

    def __init__(self, channel: Any) -> None:
        self.name, self.unit, self.comment = channel.name, channel.unit, channel.comment


def write(log: Log, path: Path) -> None:
    """MDF 4.10, one channel group per group; missing values are NaN or, in integers, marked invalid."""
    asammdf = need("asammdf", "mdf")
    with closing(asammdf.MDF(version="4.10")) as file:
        for group in log.groups.values():
            signals = [_to_mdf(asammdf, group, name) for name in group.signals]
            if signals:
                file.append(signals, acq_name=group.name, comment="")
        signals_about = {n: s.to_metadata() for n, s in log.signals.items()}
        events = [e.to_json() for e in log.events]
        text = about_json(log, events=events, signals=signals_about)
        file.attach(text.encode(), file_name=ABOUT, mime="application/json", embedded=True)
        file.save(path, overwrite=True, compression=2)


def _to_mdf(asammdf: Any, group: Group, name: str) -> Any:
    column = group.frame[name]
    invalid = None
    if column.dtype == pl.String:
        samples = np.array([v.encode() for v in column.fill_null("").to_list()], dtype=bytes)
    elif column.dtype.is_float():
        samples = column.fill_null(float("nan")).to_numpy()
    else:
        column = column.cast(pl.UInt8) if column.dtype == pl.Boolean else column
        invalid = column.is_null().to_numpy() if column.null_count() else None
        samples = column.fill_null(0).to_numpy()
    unit = group.signals[name].unit or ""
    words = {"encoding": "utf-8"} if column.dtype == pl.String else {}
    return asammdf.Signal(samples, group.time, name=name, unit=unit, invalidation_bits=invalid, **words)
