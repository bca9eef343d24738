"""Several files that continue one another, as one log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import polars as pl

from ingest.errors import LogError, did_you_mean
from ingest.files import read_blocks, read_header
from ingest.log import TIME, Group, Log
from ingest.maps import NameMap


def read_continued(
    paths: Sequence[Path], map: NameMap | Path | None = None, progress: Callable[[float], None] | None = None
) -> Iterator[Log]:
    """The parts (see :func:`ingest.files.read_blocks`) of files that a recorder began anew, in order.

    Files that know their ``start_time`` are put in its order and shifted by it; of others the order given
    counts, and one whose clock begins again before the end of the last is put one sample behind it, and told.

    Raises:
        LogError: a file does not have the same groups and signals as the first.
    """
    starts = {p: s for p in paths if (s := _start(p)) is not None}
    ordered = sorted(paths, key=starts.__getitem__) if len(starts) == len(set(paths)) else list(paths)
    sources: list[dict[str, Any]] = []
    notes: dict[str, list[str]] = {"notes": [], "salvaged": []}
    first: Log | None = None
    end = step = 0.0
    for number, path in enumerate(ordered):
        shift: float | None = None
        part: Log | None = None
        for part in read_blocks(path, map, _share(progress, number, len(ordered))):
            first = part if first is None else first
            _same(first, part, ordered[0], path)
            if shift is None:
                shift, told = _shift(first, part, end, step) if number else (0.0, None)
                notes["notes"] += [f"{path.name}: {told}"] if told else []
            moved = _moved(part, shift)
            if sampled := [g for g in moved.groups.values() if g.frame.height]:
                end = max(end, moved.span[1])
                step = min((1 / g.rate_hz for g in sampled if g.rate_hz), default=step)
            yield replace(moved, name=first.name, facts=first.facts)
        assert part is not None  # a file has at least one part
        sources.append({k: part.facts[k] for k in ("file", "sha256", "start_time") if k in part.facts})
        for kind, lines in notes.items():
            lines += [f"{path.name}: {line}" for line in part.facts.get(kind, ())]
    assert first is not None  # there is at least one file
    facts = {**first.facts, "files": sources, **{k: v for k, v in notes.items() if v}}
    groups = {k: Group(k, g.frame.clear(), g.signals) for k, g in first.groups.items()}
    yield Log(first.name, groups, (), facts)


def _start(path: Path) -> datetime | None:
    try:
        return datetime.fromisoformat(read_header(path).facts["start_time"])
    except (LogError, KeyError, ValueError):
        return None


def _share(progress: Callable[[float], None] | None, number: int, files: int) -> Callable[[float], None]:
    return lambda done: progress((number + done) / files) if progress else None


def _same(first: Log, part: Log, one: Path, other: Path) -> None:
    for name, group in first.groups.items():
        if name not in part.groups:
            raise LogError(
                f"{other} does not continue {one}: no group {name!r}; {did_you_mean(name, part.groups)}"
            )
        missing = [s for s in group.signals if s not in part.groups[name].signals]
        more = [s for s in part.groups[name].signals if s not in group.signals]
        if missing or more:
            words = [f"{w} {', '.join(s[:5])}" for w, s in (("lacks", missing), ("has more:", more)) if s]
            raise LogError(f"{other} does not continue {one}: in group {name!r} it {' and '.join(words)}")
        if group.frame.schema != part.groups[name].frame.schema:
            raise LogError(
                f"{other} does not continue {one}: in group {name!r} the types of the columns differ"
            )


def _shift(first: Log, part: Log, end: float, step: float) -> tuple[float, str | None]:
    """What is to be added to the times of a file, and a word where that is a guess."""
    starts = [log.facts.get("start_time") for log in (first, part)]
    if all(starts):
        one, other = (datetime.fromisoformat(str(s)) for s in starts)
        return (other - one).total_seconds(), None
    begin = part.span[0]
    if begin > end:
        return 0.0, None
    shift = end + step - begin
    return shift, f"its clock begins again at {begin:g} s; put behind the last file, shifted by {shift:g} s"


def _moved(part: Log, shift: float) -> Log:
    if not shift:
        return part
    groups = {k: replace(g, frame=g.frame.with_columns(pl.col(TIME) + shift)) for k, g in part.groups.items()}
    events = tuple(
        replace(e, t_start=e.t_start + shift, t_end=None if e.t_end is None else e.t_end + shift)
        for e in part.events
    )
    return replace(part, groups=groups, events=events)
