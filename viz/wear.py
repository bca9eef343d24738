"""The wear of a vehicle over its logs, and what is no wear, in the report of a batch and in its recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from stages.results import Magnitude
from viz import send
from viz.colours import DETECTED, EXCEEDANCE, GREY, ORANGE, SKY_BLUE, Colour
from viz.over_logs import Line, Trace, log_trace, traces_plot
from viz.series import Array
from viz.summary import magnitude_text
from viz.svg import style, themed

ROOT = "wear"
BARS = 2.0
"""Length of a bar to either side, in standard deviations."""
STATES: Mapping[str, Colour] = {"learned from": SKY_BLUE, "learning rests": GREY, "alarm": EXCEEDANCE}


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of wear after each log with its standard deviation, both (logs,), and its budget in ``unit``:
    ``growth`` a log, and ``total``."""

    name: str
    unit: str
    value: Array
    sd: Array
    growth: float
    total: float

    def words(self) -> str:
        """The wear in the end and its budget."""
        last = Magnitude(value=float(self.value[-1]), sd=float(self.sd[-1]), unit=self.unit)
        growth, most = (
            magnitude_text(Magnitude(value=v, sd=None, unit=self.unit))
            for v in (100 * self.growth, self.total)
        )
        return f"{spaced(self.name)}: {magnitude_text(last)} (budget {growth} in 100 logs, {most} in all)"


@dataclass(frozen=True, kw_only=True)
class Worn:
    """What was found of a vehicle's ``logs``, which follow ``reference`` fault-free ones: the ``state`` of
    each (one of :data:`STATES`), the ``evidence`` for a fault beyond any wear and its ``threshold``, the
    ``faults`` of each in words, empty where there are none, and by how many standard deviations the wear in
    the end is ``denied``, if it is."""

    vehicle: str
    reference: int
    logs: tuple[str, ...]
    kinds: tuple[Kind, ...]
    evidence: Array
    threshold: float
    state: tuple[str, ...]
    faults: tuple[str, ...]
    denied: float | None = None

    def words(self) -> list[str]:
        """The wear in the end, and what is no wear, in sentences."""
        told = [f"{kind.words()} after {self.logs[-1]}" for kind in self.kinds]
        alarms = [i for i, state in enumerate(self.state) if state == "alarm"]
        if alarms:
            first, last = (self.logs[i] for i in (alarms[0], alarms[-1]))
            told.append(
                f"alarm in {len(alarms)} of {len(self.logs)} logs, first in {first}: more than wear within "
                f"its budget; in {last} it may be {self.faults[alarms[-1]] or 'no fault of the recipe'}"
            )
        elif self.evidence[-1] > self.threshold:
            told.append(f"evidence of a fault in {self.logs[-1]}; in a second log in a row it is an alarm")
        else:
            told.append("no fault beyond the wear")
        if self.faults[-1] and not alarms:
            told.append(f"what explains the last logs as well as wear does: {self.faults[-1]}")
        if self.denied is not None:
            told.append(
                f"this wear does not show where it must ({self.denied:.1f} standard deviations): "
                "a fault that looks like it is likelier"
            )
        return told


LEGEND = (
    f"logs of the vehicle in their order. Wear: dots with ± {BARS:g} standard deviations, blue where it was "
    "learned from the log; orange: its budget. Evidence: the root of what a fault beyond any wear within the "
    "budget explains better, against the frozen reference; two logs in a row above the yellow line are an "
    "alarm (red)."
)


def wear_part(worn: Sequence[Worn]) -> str:
    """Words and plots of each vehicle as HTML."""
    parts = []
    for one in worn:
        listed = "".join(f"<li>{escape(text)}</li>" for text in one.words())
        with style():
            drawing = themed(traces_plot(_traces(one), {s: c for s, c in STATES.items() if s in one.state}))
        parts.append(
            f'<h3>{escape(one.vehicle)}</h3><ul>{listed}</ul><p class="soft">{_legend(one)}</p>{drawing}'
        )
    return f'<h2 id="wear">Wear from log to log</h2>{"".join(parts)}'


def log_wear(rec: rr.RecordingStream, worn: Sequence[Worn]) -> list[rrb.View]:
    """The same below ``/wear`` of a recording; returns the views."""
    views: list[rrb.View] = []
    for one in worn:
        path = send.entity(ROOT, one.vehicle, "words")
        listed = "\n".join(f"- {text}" for text in one.words())
        send.markdown(rec, path, f"## Wear of {one.vehicle}\n\n{listed}\n\n{_legend(one)}")
        views.append(rrb.TextDocumentView(origin=path, name=one.vehicle))
        traces = _traces(one)
        views += [log_trace(rec, send.entity(ROOT, one.vehicle, t.name), t) for t in traces]
    return views


def _legend(one: Worn) -> str:
    return f"{one.reference + len(one.logs)} {LEGEND} The first {one.reference} are the reference."


def _traces(one: Worn) -> list[Trace]:
    """The evidence, then each kind of wear."""
    shades = tuple(STATES[state] for state in one.state)
    first, last = one.reference + 1, one.reference + len(one.logs)
    threshold = np.sqrt(one.threshold)
    evidence = Trace(
        name="evidence of a fault", unit="sigma", y=np.sqrt(np.maximum(one.evidence, 0.0)), shades=shades,
        first=first, lines=(_level(0.0, last, GREY), _level(threshold, last, DETECTED)),
    )  # fmt: skip
    return [evidence, *(_kind(kind, one.reference, last, shades) for kind in one.kinds)]


def _level(y: float, last: int, colour: Colour) -> Line:
    return ((0.5, y), (last + 0.5, y)), colour


def _kind(kind: Kind, reference: int, last: int, shades: tuple[Colour, ...]) -> Trace:
    scale, unit = (100.0, "%") if kind.unit == "1" else (1.0, kind.unit)
    full = min(reference + kind.total / kind.growth, last)
    most = scale * (full - reference) * kind.growth
    return Trace(
        name=spaced(kind.name), unit=unit, y=scale * kind.value, shades=shades, first=reference + 1,
        bars=scale * BARS * kind.sd, lines=((((reference, 0.0), (full, most), (last, most)), ORANGE),),
    )  # fmt: skip


def spaced(name: str) -> str:
    """
    >>> spaced("volumetric_efficiency")
    'volumetric efficiency'
    """
    return name.replace("_", " ")
