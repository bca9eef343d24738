"""The one family of errors a user can meet; each names the thing, the value and the way out."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class DynoscopeError(Exception):
    """Base of every mistake that is the input's or the user's, never the program's."""


class LogError(DynoscopeError, ValueError):
    """A log cannot be read, or does not hold what is needed."""


class MapError(DynoscopeError, ValueError):
    """A name map is wrong."""


class UnitError(DynoscopeError, ValueError):
    """A unit cannot be converted."""


class RecipeError(DynoscopeError, ValueError):
    """A recipe is wrong; the message lists all its mistakes."""


class StoreError(DynoscopeError, ValueError):
    """A detector or its store is missing, damaged or does not fit."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A hint naming the nearest known names, or all of them where none is near.

    >>> did_you_mean("n_Egn", ["n_Eng", "p_Int"])
    'did you mean n_Eng? Known: n_Eng, p_Int'
    >>> did_you_mean("x", [])
    'there are none'
    """
    names = sorted(known)
    if not names:
        return "there are none"
    folded = {n.casefold(): n for n in names}
    near = [folded[n] for n in get_close_matches(name.casefold(), folded, n=3, cutoff=0.7)]
    listed = ", ".join(names[:40]) + (f", … ({len(names)} in all)" if len(names) > 40 else "")
    return f"did you mean {' or '.join(near)}? Known: {listed}" if near else f"known: {listed}"
