"""Logs in parts: consecutive rows, so that a file larger than the memory can be read and written.

Every part is a :class:`ingest.log.Log` with the same groups and signals. What is found out on the way (a flag
of a signal, a note) stands in the part where it was found; the facts of the last part are those of the whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np
import polars as pl

from ingest.errors import LogError
from ingest.log import TIME, Group, Log, Signal

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


def in_step(parts: Iterable[Log], rows: Mapping[str, int] | None = None) -> Iterator[Log]:
    """The parts cut anew, so that all groups of a part end at one time, whatever order a file has them in.

    What a group is ahead of the others is held back. ``rows`` counts the rows of the whole by group: where it
    is known, a group that has ended holds nobody up. The last part has the facts of the whole.

    Raises:
        LogError: the clock goes back to before what has been handed on.
    """
    kept: dict[str, pl.DataFrame] = {}
    seen: dict[str, int] = {}
    until = -np.inf
    part: Log | None = None
    for part in parts:
        for name, group in part.groups.items():
            frame = pl.concat([kept[name], group.frame]) if name in kept else group.frame
            kept[name] = frame if frame[TIME].is_sorted() else frame.sort(TIME, maintain_order=True)
            seen[name] = seen.get(name, 0) + group.frame.height
            if group.frame.height and (first := float(kept[name][TIME][0])) < until:
                raise LogError(
                    f"log {part.name!r}: the clock of group {name!r} goes back from {until:g} s to {first:g} "
                    "s; so large a log is read in order of time: split it where its clock begins again"
                )
        running = [n for n in kept if rows is None or seen[n] < rows.get(n, seen[n] + 1)]
        ends = [float(kept[n][TIME][-1]) if kept[n].height else until for n in running]
        until = max(until, min(ends, default=np.inf))
        yield _released(part, kept, until)
    if part is not None and any(frame.height for frame in kept.values()):
        yield _released(part, kept, np.inf)


def _released(part: Log, kept: dict[str, pl.DataFrame], until: float) -> Log:
    """Takes the rows before ``until`` out of ``kept``; at the same time as the last there may be more."""
    groups = {}
    for name, group in part.groups.items():
        count = int(np.searchsorted(kept[name][TIME].to_numpy(), until))
        groups[name] = replace(group, frame=kept[name].head(count))
        kept[name] = kept[name].slice(count)
    return replace(part, groups=groups)


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
