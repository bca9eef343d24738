"""Recipes: the stages of a diagnosis in order, with their settings, as a TOML file.

    title = "..."
    min_evidence_s = 45                 # no alarm and less usable data than this: insufficient_evidence
    channels = { maf_gain = "W_HFM" }   # the sensor that a fault concerns

    [[stage]]
    use = "align"                       # a built-in stage, or "my_module:MyStage"
    signals = ["p_Int", "W_HFM"]        # its settings are the fields of its class

A recipe for any signals (:mod:`pipeline.template`) names them in its head, by patterns such as ``outputs =
["y*"]``, and has ``{y}`` and ``{u}`` in its stages.

A recipe is checked whole: every mistake is listed at once.
"""

from __future__ import annotations

import pkgutil
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from importlib.resources import files
from itertools import takewhile
from pathlib import Path
from typing import Any, cast, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError, create_model

from ingest.errors import RecipeError, did_you_mean
from pipeline.digest import NOT_SETTINGS, settings
from pipeline.template import filled
from stages import STAGES
from stages.adapt import Wear
from stages.align import Align
from stages.stage import Stage
from stages.witness import Witness

STAGE_PARTS = ("version", "needs", "adds", "start", "step")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A checked recipe; ``stages`` have learned nothing yet."""

    name: str
    title: str = ""
    min_evidence_s: float = 45.0
    channels: Mapping[str, str] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    wear: Mapping[str, Wear] = field(default_factory=dict)
    witness: Witness | None = None  # of wear
    stages: tuple[Stage, ...]
    uses: tuple[str, ...]
    template: tuple[Mapping[str, Any], ...] = ()  # stages in terms of outputs and inputs

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals that a log must have; patterns, where it is a template."""
        return (*self.outputs, *self.inputs) if self.template else self._first.signals

    @property
    def optional_signals(self) -> tuple[str, ...]:
        return self._first.optional

    @property
    def _first(self) -> Align:
        return next(s for s in self.stages if isinstance(s, Align))

    def to_json(self) -> dict[str, Any]:
        """Plain values, enough to build the recipe again with :func:`build_recipe`."""
        stages = [{"use": u, **settings(s)} for u, s in zip(self.uses, self.stages, strict=True)]
        named = {k: list(v) for k in ("outputs", "inputs") if (v := getattr(self, k))}
        return {
            "title": self.title, "min_evidence_s": self.min_evidence_s, "channels": dict(self.channels),
            **named, **({"wear": {k: settings(w) for k, w in self.wear.items()}} if self.wear else {}),
            **({"witness": settings(self.witness)} if self.witness else {}),
            "stage": list(self.template) or stages,
        }  # fmt: skip

    def versions(self) -> dict[str, str]:
        """Version of each stage's algorithm, by its place and name."""
        return {f"{i}.{u}": s.version for i, (u, s) in enumerate(zip(self.uses, self.stages, strict=True))}


def builtin_recipes() -> list[str]:
    """Names of the recipes that come with the program."""
    return sorted(p.name.removesuffix(".toml") for p in _folder().iterdir() if p.name.endswith(".toml"))


def recipe_text(name: str) -> str:
    """The TOML text of a recipe: a built-in name or a path.

    Raises:
        RecipeError: there is neither.
    """
    if name in builtin_recipes():
        return str((_folder() / f"{name}.toml").read_text(encoding="utf-8"))
    path = Path(name)
    if path.suffix != ".toml" and not path.exists():
        hint = did_you_mean(name, builtin_recipes())
        raise RecipeError(f"there is no recipe {name!r}; {hint}; or give the path of a TOML file")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"recipe {name!r} cannot be read: {error}") from None


def load_recipe(name: str | Path) -> Recipe:
    """A built-in recipe by name, or one from a file.

    Raises:
        RecipeError: it cannot be read, or has mistakes; all are listed.
    """
    text = recipe_text(str(name))
    path = Path(name)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"recipe {str(name)!r} is not TOML: {error}") from None
    if str(name) in builtin_recipes():
        return build_recipe(str(name), data)
    if (folder := str(path.resolve().parent)) not in sys.path:
        sys.path.append(folder)  # a recipe's own stages lie beside it
    return build_recipe(path.stem, data)


def build_recipe(name: str, data: Mapping[str, Any]) -> Recipe:
    """A recipe from the values of its TOML file.

    Raises:
        RecipeError: all mistakes, one a line.
    """
    head = {k: v for k, v in data.items() if k != "stage"}
    problems: list[str] = []
    known = {f.name: f for f in fields(Recipe) if f.name not in ("name", "stages", "uses", "template")}
    values = _validate(Recipe, known, head, "", problems) or {}
    written = data.get("stage")
    listed = filled(written, values.get("outputs", ()), values.get("inputs", ()))
    if not isinstance(listed, list) or not listed or not all(isinstance(entry, dict) for entry in listed):
        problems.append("no [[stage]]; a recipe lists its stages in order, the first is align")
        listed = []
    stages = [_build_stage(i, dict(entry), problems) for i, entry in enumerate(listed, start=1)]
    built = [s for s in takewhile(lambda s: s is not None, stages) if s is not None]
    if built and not isinstance(built[0], Align):
        problems.append(f"stage 1 is {listed[0].get('use')!r}; the first must be 'align'")
    elif built:  # what comes after a stage that could not be built may need what that one adds
        problems += dataflow_problems(built)
        problems += witness_problems(values.get("witness"), values.get("wear", {}), built)
    if problems:
        lines = "\n".join(f"  - {p}" for p in problems)
        raise RecipeError(f"recipe {name!r} has {len(problems)} mistake(s):\n{lines}")
    uses = tuple(str(entry["use"]) for entry in listed)
    template = tuple(written) if listed != written and isinstance(written, list) else ()
    built_all = tuple(s for s in stages if s is not None)
    return Recipe(name=name, **values, stages=built_all, uses=uses, template=template)


def stage_of(use: str, values: Mapping[str, Any]) -> Stage:
    """A stage from its :func:`pipeline.digest.settings`.

    Raises:
        RecipeError: this version has no such stage, or it does not take them.
    """
    problems: list[str] = []
    stage = _build_stage(1, {"use": use, **values}, problems)
    if stage is None:
        raise RecipeError("\n".join(problems))
    return stage


def dataflow_problems(stages: list[Stage]) -> list[str]:
    """Columns that a stage needs and that no stage before it makes."""
    problems, present = [], {"time", *stages[0].adds}
    for i, stage in enumerate(stages[1:], start=2):
        for name in sorted(stage.needs - present):
            kind = type(stage).__name__.lower()
            problems.append(f"stage {i} ({kind}) needs {name!r}; {did_you_mean(name, present)}")
        present = ({"time"} if isinstance(stage, Align) else present) | stage.adds
    return problems


def witness_problems(witness: Witness | None, wear: Mapping[str, Wear], stages: list[Stage]) -> list[str]:
    """Columns that the witness of the wear needs and no stage makes, and kinds of wear that there are not."""
    if witness is None:
        return []
    present: set[str] = set()
    for stage in stages:
        present = (set() if isinstance(stage, Align) else present) | stage.adds
    lacking = [(n, present) for n in sorted(witness.needs - present)]
    lacking += [(n, {*wear}) for n in witness.wear if n not in wear]
    return [f"witness: there is no {name!r}; {did_you_mean(name, known)}" for name, known in lacking]


def _build_stage(number: int, entry: dict[str, Any], problems: list[str]) -> Stage | None:
    use = entry.pop("use", None)
    where = f"stage {number} ({use})"
    if not isinstance(use, str):
        problems.append(f"stage {number} has no `use`; known stages: {', '.join(STAGES)}")
        return None
    if use not in STAGES and ":" not in use:
        problems.append(
            f"stage {number}: unknown stage {use!r}; {did_you_mean(use, STAGES)}; or 'module:Class'"
        )
        return None
    try:
        cls = pkgutil.resolve_name(STAGES.get(use, use))
    except Exception as error:  # a user's module may raise anything
        problems.append(f"{where} cannot be loaded: {type(error).__name__}: {error}")
        return None
    if not is_dataclass(cls):
        problems.append(f"{where}: {use!r} is not a dataclass; a stage's fields are its settings")
        return None
    if lacking := [part for part in STAGE_PARTS if not hasattr(cls, part)]:
        problems.append(f"{where}: {use!r} has no {', '.join(lacking)}; see stages.stage.Stage")
        return None
    known = {f.name: f for f in fields(cls) if f.name not in NOT_SETTINGS}
    if (values := _validate(cls, known, entry, where + ": ", problems)) is None:
        return None
    try:
        return cast(Stage, cast(Any, cls)(**values))
    except (RecipeError, ValueError, TypeError) as error:
        problems.append(f"{where}: {error}")
        return None


def _validate(
    cls: Any, known: Mapping[str, Field[Any]], given: Mapping[str, Any], where: str, problems: list[str]
) -> dict[str, Any] | None:
    """``given`` converted to the types of the fields ``known``, unknown ones left out; what is wrong goes to
    ``problems``. None where the others cannot be used either."""
    hints = get_type_hints(cls)
    definition: dict[str, Any] = {}
    for name, f in known.items():
        required = f.default is MISSING and f.default_factory is MISSING
        definition[name] = (hints[name], ... if required else None)
    problems += [
        f"{where}unknown setting {name!r}; {did_you_mean(name, known)}" for name in given if name not in known
    ]
    model = create_model("settings", __config__=ConfigDict(extra="forbid", frozen=True), **definition)
    try:
        checked = TypeAdapter(model).validate_python({k: v for k, v in given.items() if k in known})
    except ValidationError as error:
        for problem in error.errors():
            path = ".".join(str(p) for p in problem["loc"])
            if problem["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
                problems.append(f"{where}unknown setting {path!r}")
            elif problem["type"] == "missing":
                problems.append(f"{where}setting {path!r} is missing")
            else:
                problems.append(f"{where}{path} = {problem['input']!r}: {problem['msg']}")
        return None
    return {n: getattr(checked, n) for n in checked.model_fields_set}


def _folder() -> Any:
    return files("pipeline") / "recipes"
