"""States over time as lanes: what was injected, what was found, and where the system was meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from ingest.log import Event, Log
from stages.results import Diagnosis
from viz import send
from viz.colours import EXCEEDANCE, GREY, SAND, Colour, of_fault, of_index
from viz.series import TRUTH, Array, lane

# Rerun sorts lanes by path: these names stand in the order in which they are read.
ALARM = "/alarm"
DIAGNOSED = "/fault_diagnosed"
INJECTED = "/fault_injected"
IN_DOMAIN = "/in_domain"
QUALITY = "/quality"
REGIME = "/regime"

FAULT_LANES = (ALARM, DIAGNOSED, INJECTED)
MOMENT = 0.002


def truth(log: Log) -> list[Event]:
    """The injected faults of a log whose truth is known."""
    return [event for event in log.events if event.source == "truth" and event.kind != "none"]


def truth_known(log: Log) -> bool:
    """Whether a log says what was wrong, be it that nothing was."""
    return any(event.source == "truth" for event in log.events)


def quality_remarks(log: Log) -> list[Event]:
    """What the readers remarked on the log's data, but for what a simulator alone knows."""
    return [e for e in log.events if e.source == "quality" and not (e.channel or "").startswith(TRUTH)]


def log_lanes(rec: rr.RecordingStream, diagnosis: Diagnosis) -> list[str]:
    """The lanes of a run; returns their paths."""
    samples = diagnosis.samples
    time = samples["time"].to_numpy()
    verdicts = diagnosed(samples)
    _log_states(rec, DIAGNOSED, time, verdicts, {f: of_fault(f) for f in set(verdicts.tolist())})
    alarm = np.where(samples["detection"].to_numpy() > 0, "alarm", "no alarm")
    _log_states(rec, ALARM, time, alarm, {"alarm": EXCEEDANCE})
    paths = [ALARM, DIAGNOSED, *log_event_lanes(rec, diagnosis.log)]
    if "regime" in samples.columns:
        regimes = samples["regime"].fill_null(-1).to_list()
        palette = {regime_name(r): of_index(r) for r in set(regimes)}
        _log_states(rec, REGIME, time, np.array([regime_name(r) for r in regimes]), palette)
        paths.append(REGIME)
    if "in_domain" in samples.columns:
        inside = np.where(samples["in_domain"].fill_null(False).to_numpy(), "known", "outside")
        _log_states(rec, IN_DOMAIN, time, inside, {"outside": GREY})
        paths.append(IN_DOMAIN)
    return paths


def regime_name(regime: int) -> str:
    """``R<number>``, and nothing for a sample that belongs to no regime (below 0)."""
    return f"R{regime}" if regime >= 0 else ""


def diagnosed(samples: pl.DataFrame) -> NDArray[np.str_]:
    """The most probable hypothesis of each row in alarm, ``"none"`` elsewhere, shape (rows,).

    >>> frame = pl.DataFrame({"detection": [0, 1], "p.a": [0.0, 0.3], "p.unknown": [0.0, 0.7]})
    >>> diagnosed(frame).tolist()
    ['none', 'unknown']
    """
    faults = np.array([c.removeprefix("p.") for c in samples.columns if c.startswith("p.")])
    alarm = samples["detection"].to_numpy() > 0
    if not faults.size:
        return np.where(alarm, "unknown", "none")
    p = samples.select(pl.col("^p\\..*$").fill_null(0.0).fill_nan(0.0)).to_numpy()
    return np.where(alarm, faults[p.argmax(axis=1)], "none")


def log_event_lanes(rec: rr.RecordingStream, log: Log) -> list[str]:
    """Lanes of the log's own events: injected faults and remarks on its quality."""
    if not any(group.frame.height for group in log.groups.values()):
        return []
    quality = [
        replace(event, kind=f"{event.kind} {event.channel}") if event.channel else event
        for event in quality_remarks(log)
    ]
    paths = []
    if truth_known(log):
        _log_events(rec, INJECTED, log, truth(log), "none", of_fault)
        paths.append(INJECTED)
    if quality:
        _log_events(rec, QUALITY, log, quality, "good", lambda kind: SAND)
        paths.append(QUALITY)
    return paths


def _log_events(
    rec: rr.RecordingStream,
    path: str,
    log: Log,
    events: list[Event],
    idle: str,
    colour: Callable[[str], Colour],
) -> None:
    time, names = held(events, *log.span)
    send.states(
        rec, path, time, [name or idle for name in names[:-1]] + [""], {n: colour(n) for n in names if n}
    )


def held(events: Sequence[Event], start: float, end: float) -> tuple[Array, list[str]]:
    """What holds from each time to the next: the kinds of the events joined by ``+``, ``""`` for nothing.

    A moment is drawn ``MOMENT`` of the whole time wide, so that it can be seen.

    >>> a, b = (Event(t_start=t, t_end=t + 2.0, kind=k, source="truth") for t, k in ((1.0, "b"), (2.0, "a")))
    >>> held([a, b], 0.0, 9.0)[1]
    ['', 'b', 'a+b', 'a', '', '']
    """
    least = MOMENT * (end - start)
    windows = [
        (e.t_start, max(e.t_start + least, end if e.t_end is None else e.t_end), e.kind) for e in events
    ]
    inside = {edge for a, b, _ in windows for edge in (a, b) if start < edge < end}
    time = np.array([start, *sorted(inside), end])
    names = [""] * time.size
    for kind in sorted({kind for *_, kind in windows}):
        begun = np.searchsorted(np.sort([a for a, _, k in windows if k == kind]), time, side="right")
        ended = np.searchsorted(np.sort([b for _, b, k in windows if k == kind]), time, side="right")
        names = [
            f"{n}+{kind}" if n and on else kind if on else n
            for n, on in zip(names, begun > ended, strict=True)
        ]
    return time, names


def _log_states(
    rec: rr.RecordingStream, path: str, time: Array, states: NDArray[np.str_], palette: dict[str, Colour]
) -> None:
    at, names = lane(time, states)
    send.states(rec, path, at, names, palette)
