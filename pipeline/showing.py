"""A replay in a viewer, or in words."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress

from ingest.log import TIME, Log
from ingest.quality import Quality
from ingest.report import quality, with_quality
from pipeline.detector import Detector
from pipeline.replaying import Step, replay
from stages.results import DETECTION, Diagnosis

Tell = Callable[[str], None]


def replay_log(
    log: Log, detector: Detector, speed: float | None, *, viewer: bool, web: bool, tell: Tell
) -> Diagnosis:
    """Replay ``log``; every alarm that begins or changes its name is told as it happens. A viewer stays open
    until it is closed.

    Raises:
        LogError: the log lacks a signal that the recipe needs.
        DynoscopeError: the viewer cannot be opened.
    """
    found = Quality()
    found.add(log)
    log = with_quality(log, found)
    told = _Told(tell)
    if not viewer:
        return replay(log, detector, told.step, quality=quality(log, found), speed=speed)
    from viz.live import Live
    from viz.viewer import live_recording

    with ExitStack() as stack:
        rec, wait = stack.enter_context(live_recording(log.name, web=web))
        live: list[Live] = []

        def step(one: Step) -> None:
            if not live:
                live.append(Live(rec, log, one.samples, one.plane))
            live[0].step(one.part, one.samples, one.plane)
            told.step(one)

        diagnosis = replay(log, detector, step, quality=quality(log, found), speed=speed)
        live[0].end(diagnosis)
        with suppress(KeyboardInterrupt):  # the way to end it
            tell("the replay is over; close the viewer, or stop with Ctrl-C")
            wait()
    return diagnosis


class _Told:
    """Says when an alarm begins, changes its name, or ends."""

    def __init__(self, tell: Tell) -> None:
        self.tell = tell
        self.fault = "none"

    def step(self, one: Step) -> None:
        from viz.lanes import diagnosed

        if not one.samples.height or DETECTION not in one.samples.columns:
            return
        for time, fault in zip(one.samples[TIME].to_list(), diagnosed(one.samples).tolist(), strict=True):
            if fault != self.fault:
                self.tell(f"{time:.1f} s: {'no alarm' if fault == 'none' else f'alarm, {fault}'}")
                self.fault = fault
