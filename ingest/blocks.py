"""Logs in parts: consecutive rows, so that a file larger than the memory can be read and written.

Every part is a :class:`ingest.log.Log` with the same groups and signals. What is found out on the way (a flag
of a signal, a note) stands in the part where it was found; the facts of the last part are those of the whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import polars as pl

from ingest.errors import LogError
from ingest.log import Group, Log, Signal

BLOCK_BYTES = 1 << 24
"""Size of a part as bytes of the source, about."""


def join(parts: Iterable[Log]) -> Log:
    """The whole of consecutive parts.

    Raises:
        LogError: there are none.
    """
    whole: Log | None = None
    found: dict[str, list[Group]] = {}
    for part in parts:
        whole = part if whole is None else follow(whole, part)
        for name, group in part.groups.items():
            found.setdefault(name, []).append(group)
    if whole is None:
        raise LogError("no part of a log to join")
    groups = {k: _end_to_end(found[k], g.signals) for k, g in whole.groups.items()}
    return replace(whole, groups=groups)


def follow(before: Log, part: Log) -> Log:
    """What is known after ``part``: its facts, the flags and events of both; no rows."""
    groups = {}
    for name, group in part.groups.items():
        known = before.groups[name].signals
        signals = {s: _both(known[s], signal) for s, signal in group.signals.items()}
        groups[name] = Group(name, group.frame.clear(), signals)
    return replace(part, groups=groups, events=tuple(dict.fromkeys((*before.events, *part.events))))


def rows(log: Log, size: int) -> Iterator[Log]:
    """``log`` in parts of at most ``size`` rows a group, at least one part."""
    most = max((g.frame.height for g in log.groups.values()), default=0)
    for start in range(0, max(most, 1), size):
        yield replace(
            log, groups={k: replace(g, frame=g.frame.slice(start, size)) for k, g in log.groups.items()}
        )


def _both(before: Signal, now: Signal) -> Signal:
    return replace(now, flags=tuple(dict.fromkeys((*before.flags, *now.flags))))


def _end_to_end(groups: list[Group], signals: Mapping[str, Signal]) -> Group:
    filled = [g for g in groups if g.frame.height] or groups[:1]
    if len(filled) == 1 and dict(filled[0].signals) == dict(signals):
        return filled[0]
    return Group(filled[0].name, pl.concat([g.frame for g in filled]), signals)
