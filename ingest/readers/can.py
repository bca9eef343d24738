"""CAN traces (BLF, ASC), by ``python-can``, decoded with the DBC files that the map names, by ``cantools``.

One group per message. Without a DBC each identifier is a group of its bytes, to show what is there.
"""

from __future__ import annotations

import re
import struct
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.can_signals import decode, describe
from ingest.clock import iso
from ingest.errors import LogError
from ingest.log import TIME, Group, Log, Signal
from ingest.maps import NameMap
from ingest.readers import Recording, need
from ingest.tables import distinct

NOT_DECODED = "bytes as sent: no DBC describes this message"
_DATE = 1e9  # s; time stamps beyond are dates
_PGN = 0x03FFFF00  # the part of a J1939 identifier that names the message
_FATAL = (ValueError, KeyError, IndexError, TypeError, OverflowError, struct.error, EOFError)


class Key(NamedTuple):
    """Frames that belong together."""

    bus: Any
    number: int
    extended: bool


def is_mine(path: Path, head: bytes) -> bool:
    """Whether the file begins as a BLF or a CAN ASC file."""
    return head.startswith(b"LOGG") or bool(re.match(rb"\s*date [^\n]*\n\s*base +(hex|dec)", head))


def header(path: Path, names: NameMap) -> Recording:
    """Messages and signals; a trace has no list of them, so it is read."""
    found = read(path, names)
    groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in found.log.groups.items()}
    rows = {k: g.frame.height for k, g in found.log.groups.items()}
    return Recording(Log(found.log.name, groups, (), {**found.log.facts, "rows": rows}))


def read(path: Path, names: NameMap) -> Recording:
    """All data frames.

    Raises:
        LogError: damaged, without frames, or a DBC that cannot be read.
    """
    messages = _messages(names.dbc)
    frames, problem = _frames(path)
    if not frames:
        raise LogError(f"{path}: no CAN frames{f': {problem}' if problem else ''}")
    start = min(times[0] for times, _ in frames.values())
    start = start if start > _DATE else 0.0
    groups: dict[str, Group] = {}
    unknown: Counter[str] = Counter()
    buses = len({key.bus for key in frames})
    for key, (times, data) in sorted(frames.items(), key=lambda f: f[1][0][0]):
        message = messages.get((key.number, key.extended)) or messages.get((key.number & _PGN, key.extended))
        name = message.name if message else f"{key.number:X}{'x' if key.extended else ''}"
        name = f"{name}@{key.bus}" if buses > 1 or name in groups else name
        if message is None:
            unknown[name] = len(times)
        groups[name] = _group(name, np.array(times) - start, data, message)
    facts: dict[str, Any] = {"start_time": iso(round(start * 1e9))} if start else {}
    if unknown and names.dbc:
        few = ", ".join(f"{n} ({c})" for n, c in unknown.most_common(8))
        facts["notes"] = [
            f"{sum(unknown.values())} frames of {len(unknown)} identifiers are in no DBC: {few}"
        ]
    elif unknown:
        facts["notes"] = ['no DBC: frames are shown as bytes; a map names it: dbc = ["..."], or --dbc']
    if problem:
        facts["salvaged"] = [problem]
    return Recording(Log(path.stem, distinct(groups), (), facts))


def _messages(paths: Sequence[Path]) -> dict[tuple[int, bool], Any]:
    if not paths:
        return {}
    cantools = need("cantools", "can")
    found: dict[tuple[int, bool], Any] = {}
    for path in paths:
        try:
            database = cantools.database.load_file(path, strict=False)
        except OSError as error:
            raise LogError(f"DBC {path} cannot be read: {error.strerror or error}") from error
        except Exception as error:  # the parsers raise many kinds
            raise LogError(f"DBC {path} is not a DBC, ARXML, KCD or SYM file: {error}") from error
        for message in database.messages:
            number, extended = message.frame_id, message.is_extended_frame
            found.setdefault((number, extended), message)
            if message.protocol == "j1939":
                found.setdefault((number & _PGN, extended), message)
    return found


def _frames(path: Path) -> tuple[dict[Key, tuple[list[float], list[bytes]]], str | None]:
    """Times and data by message, and what kept the file from being whole."""
    can = need("can", "can")
    found: dict[Key, tuple[list[float], list[bytes]]] = defaultdict(lambda: ([], []))
    count, problem = 0, None
    binary = path.open("rb").read(4) == b"LOGG"
    try:
        with (can.BLFReader if binary else can.ASCReader)(path) as file:
            declared = getattr(file, "object_count", None)
            for m in file:
                count += 1
                if m.is_error_frame or m.is_remote_frame or not m.data:
                    continue
                times, data = found[Key(m.channel, m.arbitration_id, m.is_extended_id)]
                times.append(m.timestamp)
                data.append(bytes(m.data))
    except (*_FATAL, can.CanError) as error:
        problem = f"the file is damaged behind frame {count}: {error or type(error).__name__}"
        if not count:
            raise LogError(f"{path}: damaged CAN trace: {error or type(error).__name__}") from error
    else:
        if binary and declared and count < declared:
            problem = f"the file breaks off: {count} of {declared} frames were found"
        elif not binary and b"End Trigger" not in _tail(path):
            problem = f"the file breaks off: it has no end mark behind its {count} frames"
    return dict(found), problem


def _tail(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 200))
        return file.read()


def _group(name: str, time: NDArray[np.float64], data: list[bytes], message: Any) -> Group:
    sizes = np.array([len(d) for d in data])
    width = int(sizes.max())
    matrix = np.frombuffer(b"".join(d.ljust(width, b"\0") for d in data), np.uint8).reshape(-1, width)
    if message is not None and message.signals:
        columns, signals = decode(message, matrix, sizes), describe(message)
    else:
        columns = {f"{name}.byte{i}": pl.Series(matrix[:, i].copy()) for i in range(width)}
        signals = {n: Signal(name=n, kind="state", resample="hold", flags=(NOT_DECODED,)) for n in columns}
    return Group(name, pl.DataFrame({TIME: time, **columns}), signals)
