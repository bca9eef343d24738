"""Replaying a log causally through the stages of a detector, at the pace at which it happened or faster."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from ingest.log import Log
from pipeline.detector import Detector
from pipeline.diagnosing import concluded, operating_map, samples_table
from stages.results import Diagnosis, OperatingMap
from stages.stage import ANALYSIS, concat, cut, run_stages

UPDATES_HZ = 10.0
UNPACED_S = 5.0
"""Length of a stretch where nobody watches."""
NAP_S = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """What one stretch of the log brought: its own rows, None for what the stages still held at the end, and
    the samples made of all rows up to its end."""

    part: Log | None
    samples: pl.DataFrame
    plane: OperatingMap | None


def replay(
    log: Log,
    detector: Detector,
    on_step: Callable[[Step], None],
    *,
    quality: Mapping[str, Any] | None = None,
    speed: float | None = None,
) -> Diagnosis:
    """The diagnosis of ``log``, made stretch by stretch as if it were being recorded.

    ``speed``: seconds of the log to one of the clock, None: as fast as it goes. What ``on_step`` is shown of
    a stretch depends on nothing later; the diagnosis is that of :func:`pipeline.diagnosing.diagnose`.

    Raises:
        LogError: the log lacks a signal that the recipe needs.
    """
    stretch = UNPACED_S if speed is None else max(speed, 1.0) / UPDATES_HZ
    waiting: deque[Log] = deque()

    def watched(parts: Iterable[Log]) -> Iterator[Log]:
        for part in parts:
            waiting.append(part)
            yield part

    wait, start = Pace(speed), log.span[0]
    blocks = []
    for block in run_stages(detector.stages, watched(cut(log, stretch))):
        part = waiting.popleft() if waiting else None
        if part is not None:
            wait.until(part.span[1] - start)
        blocks.append(block)
        frame = block.groups[ANALYSIS].frame
        on_step(Step(part=part, samples=samples_table(frame), plane=operating_map(detector, block)))
    return concluded(log, detector, concat(blocks), quality or {})


class Pace:
    """Waits so that ``speed`` seconds of a log take one of the clock; behind, it does not wait."""

    def __init__(self, speed: float | None) -> None:
        self.speed = speed
        self.began = time.monotonic()

    def until(self, seconds: float) -> None:
        """Returns when the log's ``seconds`` have gone by."""
        if self.speed is None:
            return
        due = self.began + seconds / self.speed
        while (left := due - time.monotonic()) > 0.0:
            time.sleep(min(left, NAP_S))
