from __future__ import annotations

import sys
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from ingest.errors import RecipeError
from pipeline.recipe import build_recipe, builtin_recipes, load_recipe, recipe_text

GOOD: dict[str, Any] = {
    "title": "two pressures",
    "stage": [
        {"use": "align", "signals": ["p_Int", "p_Bst"], "raster_s": 0.5},
        {"use": "regressors", "columns": {"dp": "p_Bst - p_Int"}},
        {"use": "gate", "rate_per_s": {"dp": 0.1}},
    ],
}


def mistakes(data: Any) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        build_recipe("r", data)
    head, *lines = str(caught.value).splitlines()
    assert head == f"recipe 'r' has {len(lines)} mistake(s):"
    return [line.removeprefix("  - ") for line in lines]


def changed(stage: int, **entries: Any) -> dict[str, Any]:
    data = deepcopy(GOOD)
    data["stage"][stage] |= entries
    return data


@pytest.mark.parametrize("name", builtin_recipes())
def test_a_copy_of_a_built_in_recipe_is_that_recipe(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.toml"
    path.write_text(recipe_text(name), encoding="utf-8")
    copy, builtin = load_recipe(path), load_recipe(name)
    assert copy == builtin
    assert build_recipe(name, builtin.to_json()) == builtin  # what a detector's record keeps is enough


def test_name_is_the_files_stem_whatever_its_suffix(tmp_path: Path) -> None:
    for file in ("mine.toml", "mine.txt"):
        (tmp_path / file).write_text(recipe_text("diesel_airpath"), encoding="utf-8")
        assert load_recipe(tmp_path / file).name == "mine"


def test_what_a_recipe_needs_and_defaults() -> None:
    recipe = build_recipe("r", GOOD)
    assert recipe.signals == ("p_Int", "p_Bst")
    assert recipe.optional_signals == ()
    assert (recipe.min_evidence_s, recipe.title) == (45.0, "two pressures")
    assert recipe.uses == ("align", "regressors", "gate")
    assert list(recipe.versions()) == ["0.align", "1.regressors", "2.gate"]


def test_every_mistake_is_listed_at_once() -> None:
    found = mistakes(
        {
            "titel": "x",
            "min_evidence_s": "long",
            "stage": [
                {"use": "align", "signals": ["p_Int"], "rastre_s": 1.0},
                {"use": "regressors", "columns": {"dp": "p_Bst - p_Int"}},
                {"use": "gaet"},
                {"use": "smooth"},
                {"rate": 1},
            ],
        }
    )
    assert len(found) == 7
    expected = (
        ("unknown setting 'titel'; did you mean title?",),
        ("min_evidence_s = 'long'", "number"),
        ("stage 1 (align): unknown setting 'rastre_s'; did you mean raster_s?",),
        ("stage 3: unknown stage 'gaet'; did you mean gate?",),
        ("stage 4 (smooth): setting 'tau_s' is missing",),
        ("stage 5 has no `use`",),
        ("stage 2 (regressors) needs 'p_Bst'; ", "p_Int"),
    )
    for line, words in zip(found, expected, strict=True):
        assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (changed(0, raster_s="fast"), "stage 1 (align): raster_s = 'fast'"),
        (changed(0, raster_s=-1.0), "stage 1 (align): align: raster_s = -1.0"),
        (changed(0, signals="p_Int"), "stage 1 (align): signals = 'p_Int'"),
        (changed(1, columns={"dp": "p_Bst -"}), "formula 'p_Bst -' cannot be read"),
        (changed(1, columns={"dp": "sqr(p_Bst)"}), "unknown function 'sqr'; did you mean sqrt?"),
        (changed(2, rate_per_s={"p_Bts": 0.1}), "stage 3 (gate) needs 'p_Bts'; did you mean p_Bst"),
        (changed(0, use="gate", rate_per_s={}), "unknown setting 'signals'"),
        ({"stage": GOOD["stage"][1:]}, "stage 1 is 'regressors'; the first must be 'align'"),
        ({"stage": []}, "no [[stage]]"),
        ({"stage": {"use": "align"}}, "no [[stage]]"),
        ({"stage": ["align"]}, "no [[stage]]"),
        ({}, "no [[stage]]"),
        (changed(2, use="no_such_module:Stage"), "stage 3 (no_such_module:Stage) cannot be loaded"),
        (changed(2, use="json:Stage"), "cannot be loaded"),
        (changed(2, use="json:loads"), "is not a dataclass"),
        (changed(2, use="a b:c"), "cannot be loaded"),
        (changed(2, use=7), "stage 3 has no `use`"),
    ],
)
def test_mistake(data: dict[str, Any], words: str) -> None:
    assert any(words in line for line in mistakes(data)), mistakes(data)


def test_a_witness_knows_its_columns_and_kinds_of_wear() -> None:
    wear = {"leaking": {"residuals": {"r": "1"}, "per_100": 0.1, "total": 1.0}}
    witness = {"output": "ln(p_Bts)", "inputs": ["dp"], "wear": {"leakng": 1.0}}
    one, two = mistakes({**GOOD, "wear": wear, "witness": witness})
    assert one.startswith("witness: there is no 'p_Bts'; did you mean p_Bst")
    assert two.startswith("witness: there is no 'leakng'; did you mean leaking")
    right = {**witness, "output": "ln(p_Bst)", "wear": {"leaking": 1.0}}
    assert build_recipe("r", {**GOOD, "wear": wear, "witness": right}).witness is not None


def test_a_later_align_drops_the_columns_before_it() -> None:
    data = deepcopy(GOOD)
    data["stage"].insert(2, {"use": "align", "signals": ["p_Int"]})
    assert any("stage 4 (gate) needs 'dp'" in line for line in mistakes(data))


def test_unknown_name_and_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no recipe 'diesel'; .*diesel_airpath"):
        load_recipe("diesel")
    with pytest.raises(RecipeError, match=r"nowhere\.toml"):
        load_recipe(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(RecipeError, match="cannot be read"):
        load_recipe(tmp_path / "folder.toml")
    (tmp_path / "bad.toml").write_text("[[stage]\n")
    with pytest.raises(RecipeError, match=r"bad\.toml.* is not TOML: .*line 1"):
        load_recipe(tmp_path / "bad.toml")
    (tmp_path / "latin.toml").write_bytes("title = 'Kühler'".encode("latin-1"))
    with pytest.raises(RecipeError, match="cannot be read"):
        load_recipe(tmp_path / "latin.toml")


OWN = """
from __future__ import annotations
from dataclasses import dataclass
from typing import ClassVar
from stages.stage import add_columns, columns

@dataclass(frozen=True, kw_only=True)
class Scaled:
    version: ClassVar[str] = "7"
    column: str
    factor: float = 2.0
    @property
    def needs(self): return {self.column}
    @property
    def adds(self): return {"scaled"}
    def start(self): return None
    def step(self, state, block, /):
        return None, add_columns(block, {"scaled": self.factor * columns(block)[self.column]})

@dataclass(frozen=True)
class Bare:
    x: int = 0
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recipe file with a stage of its own beside it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "own_stages", raising=False)
    (tmp_path / "own_stages.py").write_text(OWN)
    stages = ('use = "align"\nsignals = ["p_Int"]\n', 'use = "own_stages:Scaled"\ncolumn = "p_Int"\n')
    (tmp_path / "mine.toml").write_text("".join(f"[[stage]]\n{stage}" for stage in stages))
    return tmp_path / "mine.toml"


def test_own_stage_beside_the_recipe(own: Path) -> None:
    recipe = load_recipe(own)
    assert recipe.uses == ("align", "own_stages:Scaled")
    assert recipe.versions()["1.own_stages:Scaled"] == "7"
    assert recipe.to_json()["stage"][1] == {"use": "own_stages:Scaled", "column": "p_Int", "factor": 2.0}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('column = "p_Int"', 'colum = "p_Int"', "unknown setting 'colum'; did you mean column?"),
        ('column = "p_Int"', 'column = "p_In"', "needs 'p_In'; did you mean p_Int"),
        ("own_stages:Scaled", "own_stages:Scale", "cannot be loaded"),
        ("own_stages:Scaled", "own_stages:Bare", "has no version, needs, adds, start, step"),
    ],
)
def test_mistake_with_an_own_stage(own: Path, old: str, new: str, words: str) -> None:
    own.write_text(own.read_text().replace(old, new))
    with pytest.raises(RecipeError, match=words):
        load_recipe(own)


def test_own_module_that_cannot_be_imported(own: Path) -> None:
    (own.parent / "own_stages.py").write_text("def (:\n")
    with pytest.raises(RecipeError, match="cannot be loaded: SyntaxError"):
        load_recipe(own)


def test_formula_reaches_nothing_of_python() -> None:
    for text in ("__import__('os')", "p_Bst.__class__", "[1][0]", "(lambda: 1)()"):
        assert any("formula" in line for line in mistakes(changed(1, columns={"dp": text})))


def test_recipe_text_is_toml_with_comments() -> None:
    text = recipe_text("diesel_airpath")
    assert "#" in text
    assert tomllib.loads(text)["stage"][0]["use"] == "align"
