from __future__ import annotations

import json
from pathlib import Path

import pytest

from ingest import write_log
from ingest.errors import LogError, RecipeError
from ingest.log import Log
from ingest.simulators.examples import STRUCTURES, simulate_example
from pipeline.cli import main
from pipeline.commands import select as command
from pipeline.recipe import load_recipe
from pipeline.selecting import Request, select_inputs
from stages.criteria import CRITERIA
from stages.selecting import EVIDENCE


@pytest.fixture(scope="module")
def log() -> Log:
    return simulate_example("example1", n=1500, seed=701)


@pytest.fixture(scope="module")
def path(log: Log, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("select") / "one.parquet"
    write_log(log, path)
    return path


TRUTH = STRUCTURES["example1"]
WORDS = ["--recipe", "narx", "--output", "y1", "y2", "--input", "u1", "u2"]


@pytest.mark.parametrize("more", [[], ["--search", "exhaustive"]], ids=["rule", "exhaustive"])
def test_json_has_what_is_promised(path: Path, capsys: pytest.CaptureFixture[str], more: list[str]) -> None:
    assert main(["select", str(path), *WORDS, "--json", *more]) == 0
    result = json.loads(capsys.readouterr().out)
    assert list(result) == ["y1", "y2"]
    for output, entry in result.items():
        structure = {k: entry[k] for k in ("na", "nb", "nk")}
        assert {k: set(v) for k, v in structure.items()} == {k: set(v) for k, v in TRUTH[output].items()}
        assert more or structure == TRUTH[output]
        assert entry["optimal"] is bool(more)
        assert entry["evaluated"] == (10_000 if more else entry["evaluated"])
        assert entry["evaluated"] > 0
        assert isinstance(entry["criterion"], float)
        assert 0 < entry["seconds"] < 60


def test_the_table_names_what_was_found(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["select", str(path), *WORDS[:2], "--criterion", "pooled"]) == 0
    out = capsys.readouterr().out
    assert "y1: proven optimum of 10000 genes by pooled" in out
    assert "\nu2          1   2   t-2\n" in out


def test_what_it_was_decided_on_is_written(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "pictures"
    assert main(["select", str(path), *WORDS, "--json", "--out", str(out)]) == 0
    assert sorted(p.name for p in out.iterdir()) == ["selection.json", "selection.rrd", "y1.svg", "y2.svg"]
    printed, kept = json.loads(capsys.readouterr().out), json.loads((out / "selection.json").read_text())
    assert {k: v for k, v in kept["y1"].items() if k != "portrait"} == printed["y1"]
    assert kept["y2"]["portrait"]["output"] == "y2"
    (tmp_path / "file").touch()
    assert main(["select", str(path), *WORDS, "--out", str(tmp_path / "file")]) == 2
    assert "preparing" not in (err := capsys.readouterr().err)
    assert f"{tmp_path / 'file'} is not a folder" in err


def test_bounds_of_the_command_line_count(log: Log) -> None:
    request = Request(
        outputs=["y2"], inputs=["u1", "u2"], bounds={"na_max": 2, "nb_max": 2, "nk_max": None},  # type: ignore[dict-item]
        search={"search": "exhaustive"},
    )  # fmt: skip
    ((selection, *_),) = select_inputs([log], load_recipe("narx"), request).values()
    assert selection.space.size == 3 * 17 * 17
    assert selection.structure.na == {"y2": 2}


def test_a_recipe_that_selects_nothing_takes_signals_of_the_log(log: Log) -> None:
    recipe = load_recipe("throttle")
    with pytest.raises(RecipeError, match="name the signals with --output and --input"):
        select_inputs([log], recipe, Request())
    with pytest.raises(RecipeError, match="give both"):
        select_inputs([log], recipe, Request(outputs=["y1"]))


def test_unknown_signals_are_named(path: Path, log: Log, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["select", str(path), "--recipe", "narx", "--output", "y3", "--input", "u1"]) == 2
    assert "no output 'y3'; known: u1, u2, y1, y2; name them with --output" in capsys.readouterr().err
    with pytest.raises(LogError, match="'u9'"):
        select_inputs([log], load_recipe("throttle"), Request(outputs=["y1"], inputs=["u9"]))


def test_the_parser_knows_what_the_searches_know() -> None:
    assert (EVIDENCE, *CRITERIA) == command.CRITERIA
