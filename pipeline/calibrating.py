"""Calibrating: the thresholds and spreads of a detector set anew, its models as they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ingest.errors import LogError, RecipeError
from ingest.log import Log
from pipeline.detector import Detector, new_detector
from pipeline.fitting import learn, sections
from stages.alarm_rate import peaks, shift_for
from stages.isolate import Isolate
from stages.results import STATISTIC
from stages.stage import ANALYSIS, Stage, connected, transform

FAR = 1e6  # nats: thresholds out of reach
LEAST = 3.0  # nats: no threshold goes below, whatever rate is wanted
Progress = Callable[[str], None]


def calibrate(
    detector: Detector,
    logs: Sequence[Log],
    false_alarms: float | None = None,
    progress: Progress = lambda _: None,
) -> Detector:
    """The detector with spreads and thresholds from other fault-free ``logs``; ``false_alarms`` per hour
    moves all thresholds of the isolation alike.

    Raises:
        LogError: no logs, or too little to set a rate from.
        RecipeError: a rate is wanted of a recipe that does not isolate, or is not positive.
    """
    if not logs:
        raise LogError("nothing to calibrate on; give fault-free logs with --calibrate")
    prepare, models, decide = sections(detector.stages)
    if false_alarms is not None and not false_alarms > 0:
        raise RecipeError(f"--false-alarms {false_alarms:g}: expected alarms per hour, above 0")
    if false_alarms is not None and not any(isinstance(s, Isolate) for s in decide):
        raise RecipeError(f"--false-alarms: recipe {detector.recipe.name!r} has no stage `isolate`")
    known = [*prepare, *models]
    progress(f"setting spreads and thresholds on {len(logs)} log(s)")
    stages = [*known, *learn(decide, [(known, transform(known, log)) for log in logs])]
    origin: dict[str, object] = {"calibrated_from": detector.key}
    notes: list[str] = []
    if false_alarms is not None:
        stages, shift, hours = _moved(stages, logs, false_alarms, progress)
        origin["false_alarms"] = {
            "per_h": false_alarms,
            "shift": round(shift, 6),
            "calibration_h": round(hours, 4),
        }
        if false_alarms * hours < 1:
            notes.append(
                f"{false_alarms:g} false alarms per hour are less than one in the {hours:.2f} h of the "
                "calibration logs: extrapolated by an exponential tail"
            )
    training = detector.record["training"]
    return new_detector(detector.recipe, stages, training, logs, notes, origin)


def _moved(
    stages: Sequence[Stage], logs: Sequence[Log], per_hour: float, progress: Progress
) -> tuple[list[Stage], float, float]:
    """The stages with the isolation's thresholds moved, by how much, and the hours that say so.

    Each log is judged by thresholds from the others, where there are others.
    """
    place, isolate = next((i, s) for i, s in enumerate(stages) if isinstance(s, Isolate))
    largest = isolate.learned["largest"]
    found, hours = [], 0.0
    for i, log in enumerate(logs):
        others = np.delete(largest, i, axis=0) if len(logs) > 1 else largest
        silent = replace(isolate, learned={**isolate.learned, "threshold": isolate.thresholds(others) + FAR})
        block = transform(connected([*stages[:place], silent]), log)
        frame = block.groups[ANALYSIS].frame
        found.append(peaks(block.groups[ANALYSIS].time, frame[STATISTIC].to_numpy() + FAR))
        hours += (log.span[1] - log.span[0]) / 3600
        progress(f"{log.name}: largest excess {float(found[-1].max(initial=-np.inf)):.1f}")
    shift = shift_for(found, hours, per_hour)
    threshold = np.maximum(isolate.learned["threshold"] + shift, LEAST)
    moved = replace(isolate, learned={**isolate.learned, "threshold": threshold})
    return [*stages[:place], moved, *stages[place + 1 :]], shift, hours
