"""Imports point one way, and the command line stays light."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("ingest", "stages", "viz", "pipeline")
MAY_IMPORT = {
    "ingest": ("ingest",),
    "stages": ("stages", "ingest.log", "ingest.errors", "ingest.physics"),
    "viz": ("viz", "stages.results", "ingest.log", "ingest.errors"),
    "pipeline": ROOMS,
}
HEAVY = ("numpy", "polars", "pyarrow", "scipy", "numba", "rerun", "mcap", "pydantic", "rich")


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = node.module in ROOMS  # `from stages import x` names the module x
            names |= {f"{node.module}.{a.name}" for a in node.names} if whole else {node.module}
    return {n for n in names if n.split(".")[0] in ROOMS}


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_one_way(room: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sorted((ROOT / room).rglob("*.py"))
        for name in sorted(imported(path))
        if not any(f"{name}.".startswith(f"{allowed}.") for allowed in MAY_IMPORT[room])
    ]
    assert not wrong


@pytest.mark.parametrize("room", ROOMS)
def test_every_file_has_its_size_and_docstring(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert ast.get_docstring(ast.parse(text)), f"{path} says nothing of itself"
        assert text.count("\n") <= 350, f"{path} is more than one thing"


def test_help_is_fast_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from pipeline.cli import build_parser; build_parser().format_help(); "
        f"print(*[m for m in {HEAVY} if m in sys.modules])"
    )
    began = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == ""
    assert time.perf_counter() - began < 2.0  # 0.1 s on an idle machine; tests may share theirs


def test_no_word_of_other_places() -> None:
    """Nothing that is shipped names a folder outside the repository, and the constraints name no address."""
    for room in (*ROOMS, "data", "docs"):
        for path in (ROOT / room).rglob("*"):
            if path.suffix in (".py", ".toml", ".md"):
                text = path.read_text(encoding="utf-8")
                assert "../shared" not in text, path
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        assert re.fullmatch(r"[A-Za-z0-9_.-]+==[0-9A-Za-z.+]+|#.*|", line), line
