"""Formulas of a recipe: arithmetic on columns, written as in a textbook.

A recipe says ``r_cyl = "1 - f_Cyl * 300 / (T_Int * W_HFM)"``. Names are columns of the block (any other name
between backquotes: ``"2 * `Engine speed`"``), functions are those of :data:`FUNCTIONS`; nothing else of
Python is reachable.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import CodeType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, did_you_mean
from ingest.physics import orifice_flow

Array = NDArray[np.float64]

DISCHARGE = 0.65  # of a sharp-edged hole


def leak_flow(diameter: Array, p_up: Array, T_up: Array, p_dn: Array) -> Array:
    """Air flow in g/s out of a hole of ``diameter`` mm, from ``p_up`` (kPa, ``T_up`` in K) to ``p_dn``
    (5.26), (5.31); negative where ``p_dn`` is higher."""
    area = DISCHARGE * np.pi / 4 * (1e-3 * diameter) ** 2
    return 1e3 * orifice_flow(area, 1e3 * p_up, T_up, 1e3 * p_dn)


def or_else(x: Array, y: Array) -> Array:
    """``x``, or ``y`` where it is missing."""
    return np.where(np.isfinite(x), x, y)


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "ln": np.log,
    "exp": np.exp,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "min": np.minimum,
    "max": np.maximum,
    "leak_flow": leak_flow,
    "or_else": or_else,
}
_GLOBALS = {"__builtins__": {}, **FUNCTIONS}
_ALLOWED = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Load, ast.Constant,
    ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow, ast.USub, ast.UAdd,
)  # fmt: skip


@dataclass(frozen=True)
class Formula:
    """A compiled formula.

    >>> Formula("2 * sqrt(x) + 1")({"x": np.array([4.0, 9.0])})
    array([5., 7.])
    >>> sorted(Formula("ln(p_Int / p_Amb)").names)
    ['p_Amb', 'p_Int']
    >>> Formula("2 * `n [rpm]`")({"n [rpm]": np.array([4.0])})
    array([8.])

    Raises:
        RecipeError: not a formula, or a function that is not known.
    """

    text: str
    names: frozenset[str] = field(init=False, compare=False)
    _quoted: Mapping[str, str] = field(init=False, compare=False, repr=False)  # by the name in their place
    _code: CodeType = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        quoted = list(dict.fromkeys(re.findall(r"`([^`]+)`", self.text)))
        text = self.text
        for i, name in enumerate(quoted):
            text = text.replace(f"`{name}`", f"_quoted_{i}_")
        object.__setattr__(self, "_quoted", {f"_quoted_{i}_": n for i, n in enumerate(quoted)})
        try:
            tree = ast.parse(text, mode="eval")
        except SyntaxError as error:
            raise RecipeError(f"formula {self.text!r} cannot be read: {error.msg}") from None
        called = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
        for node in ast.walk(tree):
            if not isinstance(node, _ALLOWED) or (isinstance(node, ast.Call) and node.keywords):
                raise RecipeError(f"formula {self.text!r}: only arithmetic and function calls are possible")
            if isinstance(node, ast.Constant) and not isinstance(node.value, int | float):
                raise RecipeError(f"formula {self.text!r}: {node.value!r} is not a number")
        for function in called:
            if not isinstance(function, ast.Name) or function.id not in FUNCTIONS:
                name = ast.unparse(function)
                hint = did_you_mean(name, FUNCTIONS)
                raise RecipeError(f"formula {self.text!r}: unknown function {name!r}; {hint}")
        found = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and n not in called}
        names = {self._quoted.get(n, n) for n in found}
        object.__setattr__(self, "names", frozenset(names))
        object.__setattr__(self, "_code", compile(tree, "<formula>", "eval"))

    def __call__(self, columns: Mapping[str, Any]) -> NDArray[np.float64]:
        """The value for ``columns`` (name to array, all of one shape); undefined values are NaN.

        Raises:
            RecipeError: a name is not among ``columns``.
        """
        try:
            scope = {n: columns[n] for n in self.names}
        except KeyError:
            missing = min(self.names - columns.keys())
            hint = did_you_mean(missing, columns)
            raise RecipeError(f"formula {self.text!r}: there is no {missing!r} here; {hint}") from None
        scope |= {place: columns[n] for place, n in self._quoted.items()}
        with np.errstate(all="ignore"):
            value = np.asarray(eval(self._code, _GLOBALS, scope), dtype=np.float64)
        finite = np.isfinite(value)
        return value if finite.all() else np.where(finite, value, np.nan)
