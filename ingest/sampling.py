"""How good the time stamps of a log are."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.log import Event

GAP = 10.0  # a step longer than this many median steps is a gap
MANY = 1 << 20  # rows
THINNED = 16
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


@dataclass
class Sampling:
    """Time stamps added up part by part; what is known of them is exact up to :data:`MANY` rows.

    Of more, the median step is that of the first as many, and the percentiles are those of every
    :data:`THINNED`-th step, so that memory does not grow with the log.
    """

    rows: int = 0
    low: float = np.inf
    high: float = -np.inf
    waiting: list[Floats] = field(default_factory=list)
    folded: dict[str, Any] | None = None

    def add(self, time: Floats) -> None:
        """Takes in the next stamps."""
        if not len(time):
            return
        self.rows += len(time)
        self.low, self.high = min(self.low, float(time.min())), max(self.high, float(time.max()))
        self.waiting.append(time)
        if sum(map(len, self.waiting)) > MANY:
            self._fold()

    def copy(self) -> Sampling:
        """The same so far."""
        return replace(self, waiting=list(self.waiting), folded=self.folded and dict(self.folded))

    def quality(self) -> dict[str, Any]:
        """As :func:`clock_quality` of all stamps."""
        if self.folded is None:
            return clock_quality(self._time())
        whole = self.copy()
        whole._fold()
        assert whole.folded is not None
        low, median, high = (float(p) for p in np.percentile(whole.folded["steps"], (5, 50, 95)))
        gaps: list[tuple[float, float]] = whole.folded["gaps"]
        return {
            "rows": self.rows, "rate_hz": number(round(1 / median, 6)),
            "jitter": round((high - low) / (2 * median), 6), "gaps": whole.folded["gap_count"],
            "longest_gap": list(gaps[0]) if gaps else None,
            **{k: whole.folded[k] for k in ("duplicates", "out_of_order", "clock_jumps")},
        }  # fmt: skip

    def events(self) -> list[Event]:
        """As :func:`clock_events` of all stamps."""
        if self.folded is None:
            return clock_events(self._time())
        whole = self.copy()
        whole._fold()
        assert whole.folded is not None
        found = [event("gap", a, b, None) for a, b in whole.folded["gaps"]]
        return found + [event("clock jump", b, a, None) for a, b in whole.folded["jumps"]]

    def _time(self) -> Floats:
        return np.concatenate(self.waiting) if self.waiting else np.empty(0)

    def _fold(self) -> None:
        """Turns the waiting stamps, but for the last, into numbers."""
        time = self._time()
        step = np.diff(time)
        forward = step[step > 0]
        if not len(forward):
            return
        found = self.folded or {
            "median": float(np.median(forward)), "steps": np.empty(0), "gaps": [], "jumps": [],
            "gap_count": 0, "clock_jumps": 0, "duplicates": 0, "out_of_order": 0,
        }  # fmt: skip
        gaps = np.flatnonzero(step > GAP * found["median"])
        jumps = np.flatnonzero(step < -GAP * found["median"])
        longest = gaps[np.argsort(-step[gaps], kind="stable")][:LISTED]
        self.folded = {
            "median": found["median"],
            "steps": np.append(found["steps"], forward[::THINNED]),
            "gaps": sorted([*found["gaps"], *_ends(time, longest)], key=lambda g: g[0] - g[1])[:LISTED],
            "jumps": [*found["jumps"], *_ends(time, jumps)][:LISTED],
            "gap_count": found["gap_count"] + len(gaps),
            "clock_jumps": found["clock_jumps"] + len(jumps),
            "duplicates": found["duplicates"] + int((step == 0).sum()),
            "out_of_order": found["out_of_order"] + int((step < 0).sum()),
        }
        self.waiting = [time[-1:]]


def _ends(time: Floats, steps: NDArray[np.intp]) -> list[tuple[float, float]]:
    """The stamps on either side of each step."""
    return [(float(time[i]), float(time[i + 1])) for i in steps]


def number(value: Any) -> float | None:
    """A finite float, or None."""
    return float(value) if value is not None and np.isfinite(value) else None


def clock_events(time: Floats) -> list[Event]:
    """Gaps, longest first, and jumps back of the clock."""
    step = np.diff(time)
    if not len(step) or 0 <= step.max() <= GAP * step.min():  # none is far from the median
        return []
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
