"""What the documents say can be done, can be done."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

from benchmarks.airpath_table import SHAPES, TABLE, UNEXPECTED, with_table
from pipeline.cli import COMMANDS, build_parser
from pipeline.recipe import build_recipe, load_recipe
from pipeline.summary import SUMMARY_SCHEMA
from stages import STAGES

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "ARCHITECTURE.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
README, RECIPES, OUTPUTS, AIRPATH = (
    (ROOT / name).read_text(encoding="utf-8")
    for name in ("README.md", "docs/recipes.md", "docs/outputs.md", "docs/airpath.md")
)


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    assert [t for t in targets if "://" not in t and not (page.parent / t).exists()] == []


@pytest.mark.parametrize("page", ["README.md", "docs/viewer.md"])
def test_commands_of_a_page_are_commands(page: str) -> None:
    (shell,) = blocks((ROOT / page).read_text(encoding="utf-8"), "sh")
    lines = [shlex.split(line, comments=True) for line in shell.splitlines()]
    called = [words[1:] for words in lines if words[0] == "dynoscope"]
    assert len(called) >= 6
    for words in called:
        build_parser().parse_args(words)
    for words in lines:
        if words[0] == "cp":
            assert (ROOT / words[1]).is_file()


def test_every_command_is_in_the_changes() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert [c for c in COMMANDS if not re.search(rf"\b{c}\b", text)] == []


def test_test_files_that_prove_something_exist() -> None:
    named = re.findall(r"tests/[\w/]+(?:\.py)?", README)
    assert named
    assert [n for n in named if not (ROOT / n).exists()] == []


def test_the_recipe_that_is_explained_is_a_recipe() -> None:
    head, whole = (tomllib.loads(text) for text in blocks(RECIPES, "toml"))
    recipe = build_recipe("explained", {**head, **whole})
    assert recipe.uses == ("align", "gate", "regressors", "normalise", "relations", "residuals")


def test_the_table_that_is_shown_is_the_benchmarks() -> None:
    shown = tomllib.loads(blocks(AIRPATH, "toml")[0])["stage"]
    recipe = with_table(load_recipe("diesel_airpath"), shown[0]["residuals"], TABLE, SHAPES)
    assert shown[2]["table"] == TABLE
    assert shown[2]["shapes"] == SHAPES
    assert shown[0]["residuals"]["unexpected"] == UNEXPECTED
    assert recipe.uses[-3:] == ("residuals", "detect", "signatures")


def test_the_stage_that_is_shown_is_a_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shown_stage.py").write_text(blocks(RECIPES, "python")[0], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    stages: list[dict[str, Any]] = [
        {"use": "align", "signals": ["p_Int"]},
        {"use": "shown_stage:Scaled", "column": "p_Int"},
    ]
    assert build_recipe("own", {"stage": stages}).stages[1].adds == {"scaled"}


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_is_listed(name: str) -> None:
    assert f"\n| `{name}` |" in RECIPES


@pytest.mark.parametrize("name", SUMMARY_SCHEMA)
def test_every_column_of_the_summary_is_listed(name: str) -> None:
    assert f"`{name}`" in OUTPUTS
