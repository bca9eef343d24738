"""Fitting: what a recipe's stages learn from fault-free logs, in order.

Models learn from the training logs. Spreads and thresholds learn from calibration logs that the models have
not seen; where there are none, each quarter of the training logs is predicted by models with parameters from
the other three, which says how well the models interpolate, but nothing about other drives, days or vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from ingest.errors import LogError
from ingest.log import Log
from pipeline.detector import Detector, new_detector
from pipeline.guarding import Finding, guard, thinned
from pipeline.recipe import Recipe
from pipeline.template import bound, common_signals
from stages.continuing import gather
from stages.isolate import Isolate
from stages.poison import LEAST
from stages.relations import Relations
from stages.stage import ANALYSIS, Arrays, Learner, RowWise, Stage, connected, transform
from stages.verdict import usable_seconds

FOLDS = 4
WEAK = (
    "no calibration logs: thresholds and spreads come from held-out quarters of the training logs "
    "and know nothing of other drives, days and vehicles; give more fault-free logs with --calibrate"
)
LEFT_OUT = "left out, as they do not agree with the others: "
Progress = Callable[[str], None]
Passed = tuple[Sequence[Stage], Log]  # a block and the fitted stages that it has passed


def fit(
    logs: Sequence[Log],
    recipe: Recipe,
    calibrate: Sequence[Log] = (),
    progress: Progress = lambda _: None,
    origin: Mapping[str, Any] | None = None,
    trust: bool = False,
) -> Detector:
    """A detector of ``recipe`` from fault-free ``logs``; ``origin`` goes into its record.

    Logs that look as if a fault were in them (:mod:`pipeline.guarding`) are left out and named, unless
    ``trust``.

    Raises:
        LogError: a log lacks a signal, there is too little usable data, or too many logs look faulty; the
            message says which.
        RecipeError: the recipe and the logs do not fit.
    """
    if not logs:
        raise LogError("no logs to fit on; give at least one fault-free log")
    recipe = bound(recipe, common_signals([*logs, *calibrate]))
    prepare, models, decide = sections(recipe.stages)
    progress(f"preparing {len(logs) + len(calibrate)} log(s): {', '.join(recipe.uses[: len(prepare)])}")
    training, calibration = ([transform(prepare, log) for log in part] for part in (logs, calibrate))
    _check_amount(training, recipe.min_evidence_s)
    progress(f"fitting on {_rows(training)} samples")
    fitted = learn(models, [(prepare, block) for block in training])
    notes: list[str] = []
    if decide and not trust:
        findings = suspicious([*prepare, *fitted], decide, [*training, *calibration], len(prepare))
        if named := [f for f in findings if f]:
            notes.append(LEFT_OUT + "; ".join(map(str, named)))
            progress(notes[-1])
            origin = {**(origin or {}), "left_out": [f.to_json() for f in named]}
            logs, training = others(logs, training, findings)
            calibrate, calibration = others(calibrate, calibration, findings[-len(calibration) :])
            _check_amount(training, recipe.min_evidence_s)
            fitted = learn(models, [(prepare, block) for block in training])
    stages = [*prepare, *fitted]
    if decide:
        held_out: list[Passed] = [(stages, transform(fitted, block)) for block in calibration]
        if not calibration:
            notes.append(WEAK)
            progress("holding out quarters of the training logs")
            whole = [transform(fitted, block) for block in training]
            held_out = _hold_out(prepare, fitted, whole)
            held_out += [(stages, block) for block in whole]  # only these fill the long memories
        progress(f"setting spreads and thresholds on {_rows([block for _, block in held_out])} samples")
        stages += learn(decide, held_out)
    return new_detector(recipe, stages, logs, calibrate, notes, origin, gathered(stages, prepare, training))


def gathered(
    stages: Sequence[Stage], passed: Sequence[Stage], blocks: Sequence[Log], earlier: Arrays | None = None
) -> Arrays:
    """The sums that relations can be continued from, of blocks that have passed the stages ``passed``; none
    where the recipe has no relations, or of a kind that cannot be continued."""
    place = next((i for i, stage in enumerate(stages) if isinstance(stage, Relations)), None)
    if place is None or not isinstance(relations := stages[place], Relations):
        return {}
    if any(model.width == 0 for model in relations.models.values()):
        return {}
    between = stages[len(passed) : place]
    return gather(relations, [transform(between, block) for block in blocks], earlier)


def suspicious(
    known: Sequence[Stage], decide: Sequence[Stage], blocks: Sequence[Log], prepared: int
) -> list[Finding | None]:
    """What is suspicious about each of the blocks, which have passed the first ``prepared`` of the stages."""
    place = next((i for i, stage in enumerate(decide) if isinstance(stage, Isolate)), None)
    if place is None or len(blocks) < LEAST:
        return [None] * len(blocks)
    if all(isinstance(stage, RowWise) for stage in known[prepared:]):
        blocks = [thinned(block) for block in blocks]
    passed = [transform(known[prepared:], block) for block in blocks]
    between = learn(decide[:place], [(known, block) for block in passed])
    return guard(passed, [*known, *between, decide[place]])


def others(
    logs: Sequence[Log], blocks: Sequence[Log], findings: Sequence[Finding | None]
) -> tuple[list[Log], list[Log]]:
    """The logs and their blocks that nothing was found about."""
    keep = [i for i in range(len(logs)) if findings[i] is None]
    return [logs[i] for i in keep], [blocks[i] for i in keep]


def _check_amount(blocks: Sequence[Log], least_s: float) -> None:
    """What is too short to judge is too short to learn from."""
    usable = sum(usable_seconds(block.groups[ANALYSIS].frame) for block in blocks)
    if usable < least_s:
        names = ", ".join(block.name for block in blocks)
        raise LogError(
            f"{names}: {usable:.0f} s of usable samples (near steady state) are too few to fit on, the "
            f"recipe's min_evidence_s is {least_s:g}; take longer or more fault-free logs"
        )


def sections(stages: Sequence[Stage]) -> tuple[Sequence[Stage], Sequence[Stage], Sequence[Stage]]:
    """What comes before the first learner, the models, and all from the first stage that needs
    calibration."""
    learns = [stage.learns_from if isinstance(stage, Learner) else None for stage in stages]
    decide = next((i for i, source in enumerate(learns) if source == "calibration"), len(stages))
    prepare = next((i for i, source in enumerate(learns) if source), decide)
    return stages[:prepare], stages[prepare:decide], stages[decide:]


def learn(stages: Sequence[Stage], passed: Sequence[Passed]) -> list[Stage]:
    """The stages fitted one after the other, each on what the ones before it made of the blocks."""
    fitted: list[Stage] = []
    for stage in stages:
        if isinstance(stage, Learner):
            stage = stage.fit([block for _, block in passed], [before for before, _ in passed])
        fitted.append(stage)
        following = []
        for before, block in passed:
            (*_, ready) = connected([*before, stage])
            following.append(([*before, stage], transform([ready], block)))
        passed = following
    return fitted


def _hold_out(prepare: Sequence[Stage], fitted: Sequence[Stage], blocks: Sequence[Log]) -> list[Passed]:
    """Each quarter of the logs, predicted by models whose parameters come from the other quarters."""
    quarters = [_parts(b) for b in blocks]
    held_out: list[Passed] = []
    for fold in range(FOLDS):
        seen = [q for parts in quarters for i, q in enumerate(parts) if i != fold]
        models = [stage.refit(seen) if isinstance(stage, Learner) else stage for stage in fitted]
        held_out += [([*prepare, *models], transform(models, parts[fold])) for parts in quarters]
    return held_out


def _rows(blocks: Sequence[Log]) -> int:
    return sum(block.groups[ANALYSIS].frame.height for block in blocks)


def _parts(block: Log) -> list[Log]:
    frame = block.groups[ANALYSIS].frame
    edges = np.linspace(0, frame.height, FOLDS + 1).astype(int)
    return [
        replace(block, groups={ANALYSIS: replace(block.groups[ANALYSIS], frame=frame.slice(a, b - a))})
        for a, b in pairwise(edges)
    ]
