"""What a log holds and how good it is, as plain JSON values."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ingest.log import Group, Log, Signal
from ingest.maps import UNIT_ASSUMED, UNIT_FROM_MAP

GAP = 10.0  # a step longer than this many median steps is a gap
_LISTED = 20  # of each kind, so that a report stays readable


def clock_quality(time: NDArray[np.floating[Any]]) -> dict[str, Any]:
    """Sampling of one signal from its time stamps in s, shape (rows,), in the order of the source.

    With the steps ``d`` between successive stamps and ``d_p`` their p-th percentile (of those above 0):
    ``rate_hz = 1 / d_50``, ``jitter = (d_95 - d_5) / (2 d_50)``, a gap is a step above ``10 d_50``.

    >>> q = clock_quality(np.array([0.0, 0.1, 0.2, 0.2, 0.3, 5.3, 5.4]))
    >>> q["rate_hz"], q["duplicates"], q["gaps"], [round(t, 1) for t in q["longest_gap"]]
    (10.0, 1, 1, [0.3, 5.3])
    """
    step = np.diff(time)
    forward = step[step > 0]
    found: dict[str, Any] = {
        "rows": len(time),
        "rate_hz": None,
        "jitter": None,
        "gaps": 0,
        "longest_gap": None,
        "duplicates": int((step == 0).sum()),
        "out_of_order": int((step < 0).sum()),
    }
    if len(forward):
        low, median, high = (float(p) for p in np.percentile(forward, (5, 50, 95)))
        gaps = np.flatnonzero(step > GAP * median)
        longest = int(np.argmax(step))
        found |= {"rate_hz": _number(round(1 / median, 6)), "jitter": round((high - low) / (2 * median), 6)}
        found |= {"gaps": len(gaps)}
        found |= {"longest_gap": [float(time[longest]), float(time[longest + 1])]} if len(gaps) else {}
    return found


def quality(log: Log) -> dict[str, dict[str, Any]]:
    """Per signal: unit and where it is from, type, sampling, range, what is missing, flags.

    The sampling is that of the samples that are there, so a signal with empty cells between its own samples
    shows its own rate.
    """
    found = {}
    for group in log.groups.values():
        whole = clock_quality(group.time)
        for name, signal in group.signals.items():
            present = group.frame[name].is_not_null()
            clock = whole if present.all() else clock_quality(group.time[present.to_numpy()])
            found[name] = {"group": group.name, **_about(signal), **clock, **_values(group.frame[name])}
    return found


def describe(log: Log) -> dict[str, Any]:
    """The whole log in JSON values: facts, groups, :func:`quality` of the signals, events, what is amiss."""
    facts = dict(log.facts)
    notes, salvaged, rows = (facts.pop(k, None) for k in ("notes", "salvaged", "rows"))
    sampled = any(g.frame.height for g in log.groups.values())
    return {
        "log": log.name,
        "facts": facts,
        "span_s": list(log.span) if sampled else None,
        "groups": {k: _group(g, (rows or {}).get(k)) for k, g in log.groups.items()},
        "signals": quality(log),
        "events": [e.to_json() for e in log.events],
        "notes": notes or [],
        "salvaged": salvaged or [],
    }


def _group(group: Group, rows: int | None) -> dict[str, Any]:
    clock = clock_quality(group.time)
    return {**clock, "rows": group.frame.height if rows is None else rows, "signals": list(group.signals)}


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


def _values(values: pl.Series) -> dict[str, Any]:
    missing = values.null_count()
    numeric = values.dtype.is_numeric() or values.dtype == pl.Boolean
    ends = (values.min(), values.max()) if numeric else (None, None)
    return {
        "dtype": str(values.dtype),
        "missing": missing,
        "missing_share": round(missing / len(values), 6) if len(values) else None,
        "min": _number(ends[0]),
        "max": _number(ends[1]),
        "constant": len(values) - missing > 1 and values.drop_nulls().n_unique() == 1,
    }


def _number(value: Any) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None
