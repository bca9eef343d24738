"""Templates: recipes for any signals, such as ``narx``.

The head of a template names its signals, by patterns or in full: ``outputs = ["y*"]``, ``inputs = ["u*"]``.
In its stages

- a table under a key with ``{y}`` is repeated for every output, with the output's name in place of ``{y}``;
- ``"{outputs}"`` and ``"{inputs}"`` in a list are all of them;
- elsewhere ``{y}`` and ``{u}`` are the first output and the first input.

The patterns are matched with the signals of the logs that a detector is fitted on, and the detector's own
recipe has the names in full.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from ingest.errors import RecipeError, did_you_mean

if TYPE_CHECKING:
    from ingest.log import Log
    from pipeline.recipe import Recipe


def filled(value: Any, outputs: Sequence[str], inputs: Sequence[str]) -> Any:
    """A recipe's values with the names filled in.

    >>> filled({"f_{y}": {"output": "{y}", "all": ["{inputs}"]}}, ["a", "b"], ["u"])
    {'f_a': {'output': 'a', 'all': ['u']}, 'f_b': {'output': 'b', 'all': ['u']}}
    """
    if isinstance(value, str):
        y, u = (names[0] if names else "" for names in (outputs, inputs))
        return value.replace("{y}", y).replace("{u}", u) if outputs or inputs else value
    if isinstance(value, list | tuple):
        every = {"{outputs}": outputs, "{inputs}": inputs}
        out: list[Any] = []
        for item in value:
            named = every.get(item) if isinstance(item, str) else None
            out += [filled(item, outputs, inputs)] if named is None else list(named)
        return out
    if isinstance(value, Mapping):
        table: dict[str, Any] = {}
        for key, entry in value.items():
            if "{y}" not in key:
                table[key] = filled(entry, outputs, inputs)
                continue
            for name in outputs:
                table[key.replace("{y}", name)] = filled(_named(entry, name), outputs, inputs)
        return table
    return value


def _named(value: Any, y: str) -> Any:
    """``{y}`` replaced everywhere in a value."""
    if isinstance(value, str):
        return value.replace("{y}", y)
    if isinstance(value, list | tuple):
        return [_named(item, y) for item in value]
    if isinstance(value, Mapping):
        return {k.replace("{y}", y): _named(entry, y) for k, entry in value.items()}
    return value


def with_signals(recipe: Recipe, outputs: Sequence[str], inputs: Sequence[str]) -> Recipe:
    """A template with these outputs and inputs; an empty sequence keeps the template's own.

    Raises:
        RecipeError: the recipe is no template.
    """
    from pipeline.recipe import build_recipe

    if not recipe.template:
        raise RecipeError(
            f"recipe {recipe.name!r} has its own signals; --output and --input are for templates such as narx"
        )
    changed = {
        "outputs": list(outputs) or list(recipe.outputs),
        "inputs": list(inputs) or list(recipe.inputs),
    }
    return build_recipe(recipe.name, {**recipe.to_json(), **changed})


def common_signals(logs: Sequence[Log]) -> list[str]:
    """Numeric signals that all logs have, in the order of the first."""
    first, *others = (
        [n for g in log.groups.values() for n in g.signals if g.frame[n].dtype.is_numeric()] for log in logs
    )
    return [n for n in first if all(n in other for other in others)]


def bound(recipe: Recipe, signals: Iterable[str]) -> Recipe:
    """A template with its patterns matched with ``signals``; any other recipe as it is.

    Raises:
        RecipeError: a pattern or name is not among the signals.
    """
    from pipeline.recipe import build_recipe

    if not recipe.template:
        return recipe
    present = list(signals)
    outputs = _matches(recipe, recipe.outputs, present, "output")
    inputs = [n for n in _matches(recipe, recipe.inputs, present, "input") if n not in outputs]
    named = build_recipe(recipe.name, {**recipe.to_json(), "outputs": outputs, "inputs": inputs})
    stages = filled(list(recipe.template), named.outputs, named.inputs)
    return build_recipe(recipe.name, {**named.to_json(), "stage": stages})


def _matches(recipe: Recipe, patterns: Sequence[str], signals: Sequence[str], kind: str) -> list[str]:
    out: dict[str, None] = {}
    for pattern in patterns:
        found = [pattern] if pattern in signals else [n for n in signals if fnmatchcase(n, pattern)]
        if not found:
            raise RecipeError(
                f"recipe {recipe.name!r}: the logs have no {kind} {pattern!r}; "
                f"{did_you_mean(pattern, signals)}; name them with --{kind}, or in a copy of the recipe "
                f"(dynoscope recipe show {recipe.name})"
            )
        out |= dict.fromkeys(found)
    return list(out)
