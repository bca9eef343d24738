from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ingest.errors import RecipeError
from stages.genes import Space, Structure

EXAMPLE1 = Space.of(["y1", "y2"], ["u1", "u2"], na_max=3, nb_max=3, nk_max=7)
EXAMPLE2 = Space.of(["y"], ["u1", "u2", "u3"], na_max=3, nb_max=3, nk_max=7)
DIESEL = Space.of([], ["T_Bst", "u_Egr", "u_Vnt", "n_Eng"], na_max=0, nb_max=3, nk_max=3)


@pytest.mark.parametrize(
    ("space", "size", "bits", "candidates"),
    [(EXAMPLE1, 10_000, 14, 26), (EXAMPLE2, 62_500, 17, 33), (DIESEL, 28_561, 16, 24)],
)
def test_sizes_of_the_dissertations_spaces(space: Space, size: int, bits: int, candidates: int) -> None:
    assert (space.size, sum(space.bits), len(space.candidates)) == (size, bits, candidates)


def test_codes_of_the_true_structures() -> None:
    y1 = Structure({"y1": 1, "y2": 1}, {"u1": 2, "u2": 1}, {"u1": 1, "u2": 2})
    y = Structure({"y": 1}, {"u1": 1, "u2": 1, "u3": 0}, {"u1": 6, "u2": 4, "u3": 0})
    for space, structure, code in (
        (EXAMPLE1, y1, "01 01 10 01 001 010"),
        (EXAMPLE2, y, "01 01 01 00 110 100 000"),
    ):
        bits = space.encode(space.find(structure))
        assert "".join("01"[int(b)] for b in bits) == code.replace(" ", "")
    assert y1.regressors == (("y1", 1), ("y2", 1), ("u1", 1), ("u1", 2), ("u2", 2))


def test_the_legal_codes_are_the_genes() -> None:
    codes = (np.array(bits, dtype=bool) for bits in itertools.product((0, 1), repeat=14))
    assert sorted(g for c in codes if (g := EXAMPLE1.decode(c)) is not None) == list(range(EXAMPLE1.size))


bounds = st.integers(0, 3)


@st.composite
def spaces(draw: st.DrawFn) -> Space:
    p, q = draw(st.integers(0, 2)), draw(st.integers(1, 2))

    def of(n: int) -> tuple[int, ...]:
        return tuple(draw(bounds) for _ in range(n))

    nb = (draw(st.integers(1, 3)), *of(q - 1))
    fixed = ("u0",) if draw(st.booleans()) else ()
    return Space(tuple(f"y{i}" for i in range(p)), tuple(f"u{j}" for j in range(q)), of(p), nb, of(q), fixed)


@given(space=spaces(), share=st.floats(0, 1, exclude_max=True))
@settings(deadline=None)
def test_every_name_of_a_gene_means_the_same(space: Space, share: float) -> None:
    gene = int(share * space.size)
    structure = space.structure(gene)
    assert space.gene(space.options(gene)) == gene
    assert space.find(structure) == gene
    assert space.decode(space.encode(gene)) == gene
    assert tuple(space.candidates[c] for c in space.columns(gene)) == structure.regressors
    assert space.counts[gene] == len(space.columns(gene))
    assert all(structure.nb["u0"] for _ in space.fixed)


@given(space=spaces())
@settings(deadline=None, max_examples=30)
def test_genes_are_different_subsets(space: Space) -> None:
    some = range(0, space.size, max(1, space.size // 500))
    assert len({space.columns(g) for g in some}) == len(some)


def test_wrong_spaces_are_refused() -> None:
    for kwargs, word in (
        ({"outputs": ["a"], "inputs": ["a"]}, "named twice"),
        ({"outputs": ["a"], "inputs": ["b"], "nk_max": -1}, "must be 0 or more"),
        ({"outputs": ["a"], "inputs": ["b"], "fixed": ["bb"]}, "is no candidate; known: a, b"),
        ({"outputs": [], "inputs": []}, "no candidate"),
    ):
        with pytest.raises(RecipeError, match=word):
            Space.of(**{"na_max": 1, "nb_max": 1, "nk_max": 1, **kwargs})  # type: ignore[arg-type]
    with pytest.raises(RecipeError, match="outside the space"):
        EXAMPLE2.find(Structure({"y": 4}, {}, {}))
