"""Genes: which lags of which variables are the regressors of an output, (4.10)-(4.13).

For one output, output ``y_i`` has an order ``n_a`` (regressors ``y_i(t-1) .. y_i(t-n_a)``), input ``u_j`` an
order ``n_b`` and a delay ``n_k`` (regressors ``u_j(t-n_k) .. u_j(t-n_k-n_b+1)``). A gene with ``n_b = 0`` and
``n_k > 0`` is illegal: it would say the same as one with ``n_k = 0``. Each legal gene is another subset of
the candidates, so genes are numbered, and the space can be walked whole:

    genes = prod_i (n_a,i max + 1) prod_j (1 + n_b,j max (n_k,j max + 1)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ingest.errors import RecipeError, did_you_mean

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Block:
    """The part of a gene that one variable has: none of its candidates, or the first ``count`` of a chain.

    ``chains`` chains of ``length`` columns; chain ``c`` begins at candidate ``first + c``. A ``fixed``
    variable has at least one regressor in every gene.
    """

    name: str
    first: int
    chains: int
    length: int
    fixed: bool = False

    @property
    def options(self) -> int:
        return self.chains * self.length + (not self.fixed)

    @property
    def all_columns(self) -> range:
        """Every candidate of the variable."""
        return range(self.first, self.first + self.chains + self.length - 1)

    def columns(self, option: int) -> range:
        """The candidates of an option; options count chain by chain, after that of none."""
        chain, count = self.chosen(option)
        return range(self.first + chain, self.first + chain + count)

    def chosen(self, option: int) -> tuple[int, int]:
        """Chain and number of regressors of an option."""
        k = option if self.fixed else option - 1
        return (0, 0) if k < 0 else (k // self.length, k % self.length + 1)

    def option(self, chain: int, count: int) -> int:
        """The inverse of :meth:`chosen`."""
        return chain * self.length + count - self.fixed if count else 0


@dataclass(frozen=True)
class Structure:
    """Orders and delays of one output's model by variable."""

    na: Mapping[str, int]
    nb: Mapping[str, int]
    nk: Mapping[str, int]

    @property
    def regressors(self) -> tuple[tuple[str, int], ...]:
        """(variable, lag) pairs in the order of the candidates.

        >>> Structure({"y": 1}, {"u": 2}, {"u": 3}).regressors
        (('y', 1), ('u', 3), ('u', 4))
        """
        past = [(n, lag) for n, order in self.na.items() for lag in range(1, order + 1)]
        return (*past, *((n, self.nk[n] + i) for n, order in self.nb.items() for i in range(order)))

    def to_json(self) -> dict[str, dict[str, int]]:
        return {"na": dict(self.na), "nb": dict(self.nb), "nk": dict(self.nk)}


@dataclass(frozen=True)
class Space:
    """All genes within bounds: ``na_max`` by output, ``nb_max`` and ``nk_max`` by input; the variables in
    ``fixed`` are in every gene.

    Raises:
        RecipeError: no candidates, a negative bound, an unknown fixed variable, or one named twice.

    >>> Space.of(["y1", "y2"], ["u1", "u2"], na_max=3, nb_max=3, nk_max=7).size
    10000
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    na_max: tuple[int, ...]
    nb_max: tuple[int, ...]
    nk_max: tuple[int, ...]
    fixed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = (*self.outputs, *self.inputs)
        if twice := sorted({n for n in names if names.count(n) > 1}):
            raise RecipeError(f"{', '.join(twice)}: named twice; a signal is an output or an input")
        for kind in ("na_max", "nb_max", "nk_max"):
            if any(bound < 0 for bound in getattr(self, kind)):
                raise RecipeError(f"{kind} = {list(getattr(self, kind))} must be 0 or more")
        for name in self.fixed:
            if name not in names:
                raise RecipeError(f"fixed: {name!r} is no candidate; {did_you_mean(name, names)}")
        if not self.candidates:
            raise RecipeError("no candidate regressors; give inputs with nb_max >= 1, or na_max >= 1")

    @classmethod
    def of(
        cls,
        outputs: Sequence[str],
        inputs: Sequence[str],
        *,
        na_max: int,
        nb_max: int,
        nk_max: int,
        fixed: Sequence[str] = (),
    ) -> Space:
        """The same bounds for all variables."""
        p, q = len(outputs), len(inputs)
        return cls(tuple(outputs), tuple(inputs), (na_max,) * p, (nb_max,) * q, (nk_max,) * q, tuple(fixed))

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """One for each variable that has candidates."""
        blocks, first = [], 0
        for name, chains, length in self._chains:
            if length:
                blocks.append(Block(name, first, chains, length, name in self.fixed))
                first += chains + length - 1
        return tuple(blocks)

    @property
    def _chains(self) -> list[tuple[str, int, int]]:
        past = [(n, 1, a) for n, a in zip(self.outputs, self.na_max, strict=True)]
        exogenous = zip(self.inputs, self.nk_max, self.nb_max, strict=True)
        return [*past, *((n, k + 1, b) for n, k, b in exogenous)]

    @cached_property
    def candidates(self) -> tuple[tuple[str, int], ...]:
        """(variable, lag) of each candidate regressor."""
        out = []
        for name, chains, length in self._chains:
            start = int(name in self.outputs)
            out += [(name, lag) for lag in range(start, start + (chains + length - 1) * (length > 0))]
        return tuple(out)

    @cached_property
    def strides(self) -> tuple[int, ...]:
        """A gene's number is the sum of option times stride over the blocks; the last counts fastest."""
        sizes = [b.options for b in self.blocks]
        return tuple(int(np.prod(sizes[i + 1 :], dtype=object)) for i in range(len(sizes)))

    @property
    def size(self) -> int:
        """Number of legal genes."""
        return self.strides[0] * self.blocks[0].options

    def options(self, gene: int) -> tuple[int, ...]:
        """The option of each block."""
        return tuple(gene // s % b.options for s, b in zip(self.strides, self.blocks, strict=True))

    def gene(self, options: Sequence[int]) -> int:
        """The inverse of :meth:`options`."""
        return sum(o * s for o, s in zip(options, self.strides, strict=True))

    def columns(self, gene: int) -> tuple[int, ...]:
        """The candidates that a gene selects."""
        pairs = zip(self.blocks, self.options(gene), strict=True)
        return tuple(c for block, option in pairs for c in block.columns(option))

    def structure(self, gene: int) -> Structure:
        """Orders and delays of a gene."""
        chosen = {b.name: b.chosen(o) for b, o in zip(self.blocks, self.options(gene), strict=True)}
        none = (0, 0)
        return Structure(
            {n: chosen.get(n, none)[1] for n in self.outputs},
            {n: chosen.get(n, none)[1] for n in self.inputs},
            {n: chosen.get(n, none)[0] for n in self.inputs},
        )

    def find(self, structure: Structure) -> int:
        """The inverse of :meth:`structure`.

        Raises:
            RecipeError: it lies outside the bounds.
        """
        options = []
        for b in self.blocks:
            count = structure.na.get(b.name, 0) or structure.nb.get(b.name, 0)
            chain = structure.nk.get(b.name, 0) if count else 0
            if count > b.length or chain >= b.chains or (b.fixed and not count):
                raise RecipeError(f"{b.name}: {count} regressors from {chain} on are outside the space")
            options.append(b.option(chain, count))
        return self.gene(options)

    @cached_property
    def counts(self) -> NDArray[np.int16]:
        """Number of regressors of every gene, shape (size,)."""
        total = np.zeros(1, dtype=np.int16)
        for b in self.blocks:
            own = np.array([b.chosen(o)[1] for o in range(b.options)], dtype=np.int16)
            total = np.add.outer(total, own).ravel()
        return total

    def on_bound(self, gene: int) -> list[tuple[str, str, int]]:
        """(kind of bound, variable, its value) of every bound that a gene touches.

        >>> space = Space.of(["y"], ["u"], na_max=2, nb_max=2, nk_max=3)
        >>> space.on_bound(space.find(Structure({"y": 2}, {"u": 1}, {"u": 3})))
        [('na_max', 'y', 2), ('nk_max', 'u', 3)]
        """
        s, out = self.structure(gene), []
        for kind, names, used in (
            ("na_max", self.outputs, s.na), ("nb_max", self.inputs, s.nb), ("nk_max", self.inputs, s.nk),
        ):  # fmt: skip
            bounds = getattr(self, kind)
            out += [(kind, n, b) for n, b in zip(names, bounds, strict=True) if used[n] == b > 0]
        return out

    # (4.13): the binary code

    @cached_property
    def bits(self) -> tuple[int, ...]:
        """B_na of each output, then B_nb, then B_nk of each input."""
        return tuple(int(b).bit_length() for b in (*self.na_max, *self.nb_max, *self.nk_max))

    def encode(self, gene: int) -> NDArray[np.bool_]:
        """The gene as bits, most significant first: all n_a, all n_b, all n_k."""
        numbers = np.zeros(len(self.bits), dtype=np.int64)
        pairs = zip(self.blocks, self._fields, self.options(gene), strict=True)
        for block, (order, delay), option in pairs:
            chain, numbers[order] = block.chosen(option)
            if delay is not None:
                numbers[delay] = chain
        field, value = self._places
        return np.asarray(numbers[field] & value > 0)

    def decode(self, bits: NDArray[np.bool_]) -> int | None:
        """The gene of a binary code, None where it is illegal or outside the bounds."""
        field, value = self._places
        numbers = np.bincount(field, value * bits, minlength=len(self.bits)).astype(int).tolist()
        if any(n > b for n, b in zip(numbers, (*self.na_max, *self.nb_max, *self.nk_max), strict=True)):
            return None
        p, q = len(self.outputs), len(self.inputs)
        if any(numbers[p + q + j] and not numbers[p + j] for j in range(q)):
            return None
        options = []
        for block, (order, delay) in zip(self.blocks, self._fields, strict=True):
            if block.fixed and not numbers[order]:
                return None
            options.append(block.option(0 if delay is None else numbers[delay], numbers[order]))
        return self.gene(options)

    @cached_property
    def _fields(self) -> list[tuple[int, int | None]]:
        """Where in the code the order and the delay of each block stand."""
        p, q = len(self.outputs), len(self.inputs)
        place: dict[str, tuple[int, int | None]] = {n: (i, None) for i, n in enumerate(self.outputs)}
        place |= {n: (p + j, p + q + j) for j, n in enumerate(self.inputs)}
        return [place[b.name] for b in self.blocks]

    @cached_property
    def _places(self) -> tuple[Ints, Ints]:
        """The field of each bit, and its value."""
        pairs = [(f, 1 << i) for f, b in enumerate(self.bits) for i in reversed(range(b))]
        return np.array([f for f, _ in pairs], dtype=np.int64), np.array(
            [v for _, v in pairs], dtype=np.int64
        )
