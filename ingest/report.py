"""What a log holds and how good it is, as plain JSON values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ingest.log import Log, Signal
from ingest.mapping import UNIT_ASSUMED, UNIT_FROM_MAP
from ingest.quality import Quality

QUALITY = "quality"
"""Source of the events that :func:`with_quality` adds."""


def quality(log: Log, found: Quality | None = None) -> dict[str, dict[str, Any]]:
    """Per signal: unit and where it is from, type, sampling, range, what is missing or suspicious, flags.

    ``found`` holds the parts of a log whose rows are not in ``log``.
    """
    signals = log.signals
    types = {n: str(t) for g in log.groups.values() for n, t in g.frame.schema.items()}
    return {
        name: {"group": group, **_about(signals[name]), "dtype": types[name], **what}
        for group, name, what in _found(log, found).of_signals()
    }


def with_quality(log: Log, found: Quality | None = None) -> Log:
    """The log with what is suspicious in it as events of the source ``quality``, in place of earlier ones."""
    kept = tuple(e for e in log.events if e.source != QUALITY)
    return replace(log, events=(*kept, *_found(log, found).events()))


def describe(log: Log, found: Quality | None = None) -> dict[str, Any]:
    """The whole log in JSON values: facts, groups, :func:`quality` of the signals, events, what is amiss."""
    facts = dict(log.facts)
    notes, salvaged, rows = (facts.pop(k, None) for k in ("notes", "salvaged", "rows"))
    known = _found(log, found)
    groups = {}
    for name, group in log.groups.items():
        clock = known.clock(name).quality()
        groups[name] = {**clock, **({"rows": rows[name]} if rows else {}), "signals": list(group.signals)}
    return {
        "log": log.name,
        "facts": facts,
        "span_s": known.span,
        "groups": groups,
        "signals": quality(log, known),
        "events": [e.to_json() for e in with_quality(log, known).events],
        "notes": notes or [],
        "salvaged": salvaged or [],
    }


def _found(log: Log, found: Quality | None) -> Quality:
    if found is None:
        found = Quality()
        found.add(log)
    return found


def _about(signal: Signal) -> dict[str, Any]:
    origin = "none" if signal.unit is None else "file"
    origin = "assumed" if UNIT_ASSUMED in signal.flags else "map" if UNIT_FROM_MAP in signal.flags else origin
    return {
        "unit": signal.unit,
        "unit_from": origin,
        "kind": signal.kind,
        "source_name": signal.source_name,
        "source_unit": signal.source_unit,
        "flags": list(signal.flags),
    }
