"""The pipeline: recipes, fitting, running, the detector store, the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.batch import run
    from pipeline.diagnosing import diagnose
    from pipeline.fitting import fit
    from pipeline.recipe import load_recipe

__all__ = ["diagnose", "fit", "load_recipe", "run"]
_HOME = {"diagnose": "diagnosing", "fit": "fitting", "load_recipe": "recipe", "run": "batch"}


def __getattr__(name: str) -> Any:  # lazy: the command line must answer --help without numpy
    if name in _HOME:
        from importlib import import_module

        return getattr(import_module(f"pipeline.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
