"""Selecting the inputs of outputs from logs, on the raster and with the columns of a recipe."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple, cast

from ingest.errors import LogError, RecipeError, did_you_mean
from ingest.files import group_file
from ingest.log import Log
from pipeline.files import aside
from pipeline.recipe import Recipe
from pipeline.template import bound, common_signals, with_signals
from stages.align import Align
from stages.portrait import portrait
from stages.results import Chosen
from stages.select_inputs import SelectInputs, Target, stretches
from stages.selecting import Search, Selection, select
from stages.stage import Learner, Stage, transform

BOUNDS = ("na_max", "nb_max", "nk_max")


@dataclass(frozen=True, kw_only=True)
class Request:
    """What the command line asks for; what is empty or None is as the recipe says."""

    outputs: Sequence[str] = ()
    inputs: Sequence[str] = ()
    bounds: Mapping[str, int] = field(default_factory=dict)
    search: Mapping[str, Any] = field(default_factory=dict)
    portraits: bool = False


class Answer(NamedTuple):
    """A selection, the seconds it took, and what it was decided on where that was asked for."""

    selection: Selection
    seconds: float
    portrait: Chosen | None


def select_inputs(
    logs: Sequence[Log], recipe: Recipe, request: Request, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Answer]:
    """The selection by output.

    The logs run through the recipe's stages up to the first that learns. Without outputs and inputs in the
    request, those of the recipe's own stage `select_inputs` are searched.

    Raises:
        RecipeError: the recipe selects nothing and no outputs and inputs are given, or bounds are wrong.
        LogError: a signal is not in the logs, is constant, or has too few samples.
    """
    if recipe.template:
        if request.outputs or request.inputs:
            recipe = with_signals(recipe, request.outputs, request.inputs)
        recipe = bound(recipe, common_signals(logs))
        request = replace(request, outputs=recipe.outputs, inputs=recipe.inputs)
    stage = next((s for s in recipe.stages if isinstance(s, SelectInputs)), None)
    targets = _targets(recipe, stage, request)
    search = replace(stage.search if stage else Search(), **_criterion(request.search))
    names = list(dict.fromkeys(n for t in targets for n in t.variables))
    prepare = _prepare(recipe, names, logs)
    progress(f"preparing {len(logs)} log(s)")
    blocks = [transform(prepare, log) for log in logs]
    out: dict[str, Answer] = {}
    for target in targets:
        progress(f"{target.output}: {target.space.size} genes of {len(target.space.candidates)} candidates")
        began = time.perf_counter()
        parts, variables = stretches(blocks, target), target.variables
        selection = select(parts, variables, target.output, target.space, search)
        seconds = time.perf_counter() - began
        drawn = (
            portrait(target.output, parts, variables, target.output, selection, search.seed)
            if request.portraits
            else None
        )
        out[target.output] = Answer(selection, seconds, drawn)
        for note in selection.notes:
            progress(f"note: {target.output}: {note}")
    return out


def write_answers(answers: Mapping[str, Answer], out: Path) -> None:
    """What was selected, and on what, as JSON, as a Rerun recording and as a plot for each output.

    Raises:
        LogError: the folder cannot be written.
    """
    from viz.selection_plot import write_selection_plot
    from viz.timeline import write_selections

    chosen = [a.portrait for a in answers.values() if a.portrait is not None]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with aside(out / "selection.json") as path:
            path.write_text(json.dumps({n: to_json(*a) for n, a in answers.items()}, indent=1) + "\n")
        for one in chosen:
            with aside(out / group_file(one.name).replace(".parquet", ".svg")) as path:
                write_selection_plot(one, path)
    except OSError as error:
        raise LogError(f"cannot write {out}: {error.strerror or error}") from None
    write_selections(chosen, "input selection", out / "selection.rrd")


def to_json(selection: Selection, seconds: float, portrait: Chosen | None = None) -> dict[str, Any]:
    """What ``dynoscope select --json`` says of one output; with its ``portrait`` where there is one."""
    found = selection.found
    return ({"portrait": asdict(portrait)} if portrait else {}) | {
        **selection.structure.to_json(),
        "criterion": found.score, "evaluated": found.evaluated, "optimal": found.optimal,
        "seconds": round(seconds, 4), "criterion_name": selection.criterion, "genes": selection.space.size,
        "rows": selection.rows, "regions": selection.regions, "notes": list(selection.notes),
    }  # fmt: skip


def _criterion(search: Mapping[str, Any]) -> dict[str, Any]:
    """A criterion of a partition implies a search, and a search the criterion that goes with it."""
    given = dict(search)
    if given.get("criterion") and given["criterion"] != "evidence" and "search" not in given:
        given["search"] = "exhaustive"
    if "search" in given:
        given.setdefault("criterion", "")
    return given


def _targets(recipe: Recipe, stage: SelectInputs | None, request: Request) -> list[Target]:
    bounds = {k: v for k, v in request.bounds.items() if v is not None}
    if request.outputs and request.inputs:
        like = next(iter(stage.targets.values())) if stage and recipe.outputs else None
        usual = {k: getattr(like, k) for k in BOUNDS} if like else {"na_max": 3, "nb_max": 3, "nk_max": 7}
        outputs, inputs = tuple(request.outputs), tuple(request.inputs)
        return [
            Target(
                output=y, outputs=outputs, inputs=inputs, fixed=like.fixed if like else (), **usual | bounds
            )
            for y in outputs
        ]
    if request.outputs or request.inputs:
        raise RecipeError(f"recipe {recipe.name!r}: give both --output and --input, or neither")
    if stage is None:
        raise RecipeError(
            f"recipe {recipe.name!r} has no stage select_inputs; name the signals with --output and --input"
        )
    return [replace(t, **cast(dict[str, Any], bounds)) for t in stage.targets.values()]


def _prepare(recipe: Recipe, names: Sequence[str], logs: Sequence[Log]) -> list[Stage]:
    """The stages before the first that learns; for signals of the logs only the recipe's raster.

    Raises:
        LogError: a name is neither a signal of the logs nor a column of the recipe.
    """
    signals = common_signals(logs)
    if all(n in signals for n in names):
        return [replace(s, signals=tuple(names), optional=()) for s in recipe.stages if isinstance(s, Align)]
    prepare = list(takewhile(lambda stage: not isinstance(stage, Learner), recipe.stages))
    known = {*signals}.union(*(stage.adds for stage in prepare))
    for name in names:
        if name not in known:
            raise LogError(f"{name!r} is no signal of the logs; {did_you_mean(name, known)}")
    return [
        replace(s, optional=tuple(dict.fromkeys((*s.optional, *names)))) if isinstance(s, Align) else s
        for s in prepare
    ]
