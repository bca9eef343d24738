"""A log of any size in bounded memory: read twice in parts, diagnosed in the first pass, annotated in the
second.

What the stages say goes to the disk as it comes, and the verdict reads back only what it asks for. The
timeline shows such a log's signals as envelopes, and of many samples some, evenly taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from ingest.blocks import follow
from ingest.errors import LogError
from ingest.log import Group, Log
from ingest.quality import Quality
from ingest.recording import recording
from ingest.report import quality, with_quality
from pipeline.describing import about
from pipeline.detector import Detector
from pipeline.diagnosing import corrected, judge, operating_map, residual_units, samples_table
from pipeline.outputs import ANNOTATED, SAMPLES, SIGNALS, TIMELINE, VERDICT, annotated, to_json
from pipeline.samples import Reader, Stored, Writer, evenly, thinned, writing
from stages.monitor import SIGNALS as MONITORED
from stages.results import Diagnosis, OperatingMap
from stages.stage import ANALYSIS, run_stages

if TYPE_CHECKING:
    from viz.reduce import Reducer

Parts = Callable[[], Iterable[Log]]


def diagnose_parts(
    parts: Parts, detector: Detector, name: str, facts: dict[str, Any], draft: Path, *, timeline: bool = False
) -> tuple[Log, float]:
    """Diagnose a log whose ``parts``, in step (:func:`ingest.blocks.in_step`), can be had twice; samples,
    verdict and annotated log, and with ``timeline`` an overview, go to the folder ``draft``.

    Returns:
        The log without its rows, called ``name`` and with ``facts`` added, and the seconds it lasts.

    Raises:
        LogError: what reading raises, or the log lacks a signal that the recipe needs.
    """
    named = partial(_named, parts, name, facts)
    seen = _Seen()
    units: dict[str, str] = {}
    signals: Group | None = None
    planes: list[OperatingMap] = []
    with writing(draft / SAMPLES) as samples, writing(draft / SIGNALS) as monitored:
        for block in run_stages(detector.stages, seen.watch(named())):
            samples.add(samples_table(block.groups[ANALYSIS].frame))
            units = residual_units(block)
            signals = _added(block, monitored)
            if timeline and (plane := operating_map(detector, block)):
                planes.append(plane)
    log = replace(with_quality(seen.whole, seen.quality), name=name)
    verdict = judge(log, stored := Stored(draft / SAMPLES), detector, quality(log, seen.quality))
    (draft / VERDICT).write_text(to_json(verdict.to_json()), encoding="utf-8")
    made = Diagnosis(log=log, samples=stored.slice(0, 0), verdict=verdict, units=units, signals=signals)
    reducer = _reducer(seen.quality) if timeline else None
    added = _annotate(made, named(), draft, detector, reducer)
    if reducer:
        drawn = replace(made, log=reducer.log(log), about=about(detector), signals=_drawn(added, draft))
        _draw(drawn, planes, draft)
    start, end = seen.quality.span or (0.0, 0.0)
    return log, end - start


class _Seen:
    """What is known of the parts that have gone by."""

    def __init__(self) -> None:
        self.quality = Quality()
        self.last: Log | None = None

    def watch(self, parts: Iterable[Log]) -> Iterator[Log]:
        for part in parts:
            self.quality.add(part)
            self.last = part if self.last is None else follow(self.last, part)
            yield part

    @property
    def whole(self) -> Log:
        if self.last is None or self.quality.span is None:
            raise LogError("no samples")
        return follow(self.last, self.last)


def _named(parts: Parts, name: str, facts: dict[str, Any]) -> Iterator[Log]:
    for part in parts():
        yield replace(part, name=name, facts={**part.facts, **facts})


def _added(block: Log, writer: Writer) -> Group | None:
    """Writes the monitored signals of a block, if it has any; the group without its rows."""
    group = block.groups.get(MONITORED)
    if group is None:
        return None
    writer.add(group.frame)
    return replace(group, frame=group.frame.clear())


def _reducer(known: Quality) -> Reducer:
    from viz.reduce import Reducer

    return Reducer({name: clock.rows for name, clock in known.clocks.items()})


def _drawn(added: Group | None, draft: Path) -> Group | None:
    """As many of the monitored or corrected readings as can be looked at; None where there are none."""
    if added is None or not (draft / SIGNALS).is_file():
        return None
    return replace(added, frame=evenly(draft / SIGNALS))


def _draw(made: Diagnosis, planes: list[OperatingMap], draft: Path) -> None:
    """The recording: the log reduced, and as many samples as can be looked at."""
    from viz.timeline import write_timeline

    samples, rows = thinned(draft / SAMPLES)
    plane = None
    if planes:
        x, y = (np.concatenate([getattr(p, k) for p in planes])[rows] for k in ("x", "y"))
        plane = replace(planes[-1], x=x, y=y)
    write_timeline(replace(made, samples=samples, operating_map=plane), draft / TIMELINE)


def _annotate(
    made: Diagnosis, parts: Iterator[Log], draft: Path, detector: Detector, reducer: Reducer | None
) -> Group | None:
    """``annotated.mcap``, part by part: the samples beside the rows of the same time, and the readings of an
    isolated sensor corrected; ``reducer`` sees each part too. Returns the group of these or of the monitored
    readings, without rows."""
    part: Log | None = next(parts)
    samples, last = Reader(draft / SAMPLES), made.samples
    monitored = Reader(draft / SIGNALS) if made.signals else None
    if monitored is None and part is not None:
        group = corrected(part, made.samples, made.verdict, detector)
        made = replace(made, signals=group and replace(group, frame=group.frame.clear()))
    with (
        recording(draft / ANNOTATED, annotated(replace(made, log=part or made.log))) as recorder,
        writing(draft / SIGNALS) if monitored is None else nullcontext() as added,
    ):
        while part is not None:
            following = next(parts, None)
            rows = [float(g.time[-1]) for g in part.groups.values() if g.frame.height]
            end = np.inf if following is None else max(rows, default=-np.inf)
            if reducer:
                reducer.add(part)
            beside = replace(made, log=part, samples=samples.before(end))
            last = pl.concat([last, beside.samples])
            if monitored is not None and made.signals is not None:
                beside = replace(beside, signals=replace(made.signals, frame=monitored.before(end)))
            elif added is not None and made.signals is not None:
                beside = replace(beside, signals=corrected(part, last, made.verdict, detector))
                added.add(beside.signals.frame if beside.signals else made.signals.frame)
            recorder.add(annotated(beside))
            part, last = following, last.tail(1)
        recorder.finish(annotated(made), {})
    return made.signals
