"""Selection end to end on the dissertation's examples, and what happens with bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.errors import LogError, RecipeError
from ingest.simulators.examples import STRUCTURES, example1, example2
from stages.genes import Space
from stages.selecting import Search, Selection, select

Array = NDArray[np.float64]
NAMES1, NAMES2 = ("y1", "y2", "u1", "u2"), ("y", "u1", "u2", "u3")
SPACE1 = Space.of(NAMES1[:2], NAMES1[2:], na_max=3, nb_max=3, nk_max=7)
SPACE2 = Space.of(NAMES2[:1], NAMES2[1:], na_max=3, nb_max=3, nk_max=7)


def data1(n: int = 2000, seed: int = 501) -> Array:
    return np.column_stack(list(example1(n, 1.0, seed).values()))


def data2(n: int = 2000, seed: int = 501) -> Array:
    return np.column_stack(list(example2(n, 1.0, seed).values()))


@pytest.mark.parametrize("n", [1000, 2000])
def test_the_default_rule_finds_the_true_structures(n: int) -> None:
    for z, names, space, system in (
        (data1(n), NAMES1, SPACE1, "example1"),
        (data2(n), NAMES2, SPACE2, "example2"),
    ):
        for output, truth in STRUCTURES[system].items():
            selection = select([z], names, output, space)
            assert selection.structure.to_json() == truth
            assert not selection.found.optimal


def test_the_proven_optimum_is_true_and_the_other_searches_find_it() -> None:
    z = data1()
    proven = select([z], NAMES1, "y1", SPACE1, Search(search="exhaustive"))
    assert proven.found.optimal
    assert proven.structure.to_json() == STRUCTURES["example1"]["y1"]
    for search in ("genetic", "coordinate"):
        other = select([z], NAMES1, "y1", SPACE1, Search(search=search))
        assert other.found.gene == proven.found.gene
        assert other.found.score == pytest.approx(proven.found.score)
        assert not other.found.optimal


def test_the_printed_criterion_selects_too_few() -> None:
    found = select([data1()], NAMES1, "y1", SPACE1, Search(search="exhaustive", criterion="printed"))
    assert len(found.structure.regressors) < 5


def test_a_log_cut_in_two_gives_the_same_structure() -> None:
    z = data2()
    whole, cut = (select(s, NAMES2, "y", SPACE2) for s in ([z], [z[:900], z[900:]]))
    assert cut.rows == whole.rows - 9
    assert cut.structure == whole.structure


def test_bounds_grow_until_the_optimum_lies_inside() -> None:
    small = Space.of(NAMES2[:1], NAMES2[1:], na_max=1, nb_max=1, nk_max=6)
    given = select([data2()], NAMES2, "y", small)
    assert {w for n in given.notes for w in ("na_max = 1", "nk_max = 6") if w in n} == {
        "na_max = 1",
        "nk_max = 6",
    }
    grown = select([data2()], NAMES2, "y", small, Search(auto=True))
    assert grown.notes == ()
    assert grown.structure.to_json() == STRUCTURES["example2"]["y"]
    assert not grown.space.on_bound(grown.found.gene)
    exact = select([data1()], NAMES1, "y2", SPACE1, Search(search="exhaustive", auto=True))
    assert exact.found.optimal
    assert exact.structure.to_json() == STRUCTURES["example1"]["y2"]


def with_extra(z: Array, column: Array) -> Selection:
    space = Space.of(("y",), ("u1", "u2", "u3", "extra"), na_max=3, nb_max=3, nk_max=7)
    return select([np.column_stack([z, column])], (*NAMES2, "extra"), "y", space)


@pytest.mark.parametrize("kind", ["constant", "collinear"])
def test_useless_candidates_are_left_out_and_it_says_why(kind: str) -> None:
    z = data2(1500)
    selection = with_extra(z, np.full(1500, 7.0) if kind == "constant" else z[:, 1] - 2 * z[:, 2] + 1)
    assert (selection.structure.nb["extra"], selection.structure.nk["extra"]) == (0, 0)
    (note,) = selection.notes
    assert (
        note
        == {
            "constant": "extra is left out: it is constant, at 7",
            "collinear": "extra is left out: it is a linear combination of u1, u2",
        }[kind]
    )
    assert selection.structure.nk["u1"] == 6


def test_what_cannot_be_selected_is_an_error() -> None:
    z = data2(1500)
    with pytest.raises(LogError, match=r"y: 71 complete windows of 10 samples .* at least 102"):
        select([z[:80]], NAMES2, "y", SPACE2)
    with pytest.raises(LogError, match="nothing explains a constant"):
        select([z * np.array([0, 1, 1, 1])], NAMES2, "y", SPACE2)
    with pytest.raises(LogError, match="no sample at which"):
        select([], NAMES2, "y", SPACE2)
    fixed = replace(SPACE2, fixed=("u3",))
    with pytest.raises(LogError, match="u3 is fixed as a regressor, but it is constant"):
        select([z * np.array([1, 1, 1, 0])], NAMES2, "y", fixed)
    alone = Space.of((), ("u3",), na_max=0, nb_max=1, nk_max=0)
    with pytest.raises(LogError, match="no usable candidate is left"):
        select([z * np.array([1, 1, 1, 0])], NAMES2, "y", alone)


def test_a_fixed_variable_is_always_selected() -> None:
    selection = select([data2(1500)], NAMES2, "y", replace(SPACE2, fixed=("u3",)))
    assert selection.structure.nb["u3"] >= 1
    assert selection.structure.nk["u1"] == 6


def test_wrong_settings_are_refused() -> None:
    for wrong in ({"criterion": "mdl"}, {"criterion": "bic"}, {"rows": 10}, {"seed": -1}):
        with pytest.raises(RecipeError):
            Search(**wrong)
