"""How good the time stamps of a log are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.log import Event

GAP = 10.0  # a step longer than this many median steps is a gap
LISTED = 20  # of each kind and signal, so that a report stays readable

Floats = NDArray[np.floating[Any]]


def clock_quality(time: Floats) -> dict[str, Any]:
    """Sampling from time stamps in s, shape (rows,), in the order of the source.

    With the steps ``d`` between successive stamps and ``d_p`` their p-th percentile (of those above 0):
    ``rate_hz = 1 / d_50``, ``jitter = (d_95 - d_5) / (2 d_50)``, a gap is a step above ``10 d_50``, a clock
    jump one below ``-10 d_50``.

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
        "clock_jumps": 0,
    }
    if len(forward):
        low, median, high = (float(p) for p in np.percentile(forward, (5, 50, 95)))
        gaps = np.flatnonzero(step > GAP * median)
        longest = int(np.argmax(step))
        found |= {"rate_hz": number(round(1 / median, 6)), "jitter": round((high - low) / (2 * median), 6)}
        found |= {"gaps": len(gaps), "clock_jumps": int((step < -GAP * median).sum())}
        found |= {"longest_gap": [float(time[longest]), float(time[longest + 1])]} if len(gaps) else {}
    return found


def number(value: Any) -> float | None:
    """A finite float, or None."""
    return float(value) if value is not None and np.isfinite(value) else None


def clock_events(time: Floats) -> list[Event]:
    """Gaps, longest first, and jumps back of the clock."""
    step = np.diff(time)
    if not (step > 0).any():
        return []
    median = float(np.median(step[step > 0]))
    gaps = np.flatnonzero(step > GAP * median)
    gaps = gaps[np.argsort(-step[gaps], kind="stable")][:LISTED]
    jumps = np.flatnonzero(step < -GAP * median)[:LISTED]
    found = [event("gap", float(time[i]), float(time[i + 1]), None) for i in gaps]
    return found + [event("clock jump", float(time[i + 1]), float(time[i]), None) for i in jumps]


def event(kind: str, start: float, end: float, channel: str | None) -> Event:
    """Something the quality report has found."""
    return Event(t_start=start, t_end=end, kind=kind, channel=channel, source="quality")
