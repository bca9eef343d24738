from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from ingest import write_log
from ingest.log import Group, Log
from pipeline.cli import COMMANDS, main
from pipeline.detector import Detector
from pipeline.recipe import recipe_text
from pipeline.store import Store

ROOT = Path(__file__).parents[2]


def call(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a command."""
    capsys.readouterr()
    try:
        status = main([str(w) for w in words])
    except SystemExit as end:
        status = int(end.code or 0)
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return status, captured.out, captured.err


@pytest.fixture
def fitted(store: Store) -> list[str | Path]:
    """The options of `run` that name the detector."""
    return ["--recipe", "diesel_airpath", "--store", store.folder, "--no-timeline"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(capsys: pytest.CaptureFixture[str], command: str) -> None:
    status, out, err = call(capsys, command, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: dynoscope {command}")
    assert "--debug" in out


@pytest.mark.parametrize("words", [[], ["rnu"], ["run"], ["run", "x", "--colour"], ["recipe", "shw"]])
def test_wrong_usage(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    status, out, err = call(capsys, *words)
    assert (status, out) == (2, "")
    assert "usage: dynoscope" in err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(capsys, "--version")
    assert status == 0
    assert out.startswith("dynoscope 0.")


def test_fit_prints_the_key_and_nothing_else(
    capsys: pytest.CaptureFixture[str], logs: Path, tmp_path: Path
) -> None:
    words = ("fit", logs / "healthy1.parquet", "--recipe", "diesel_airpath", "--store", tmp_path)
    calibrate = ("--calibrate", logs / "healthy2.parquet")
    status, out, err = call(capsys, *words, *calibrate)
    assert status == 0
    assert out == f"{Store(tmp_path).champion('diesel_airpath')}\n"
    assert "as champion of diesel_airpath" in err
    status, again, err = call(capsys, *words, *calibrate, "--json")
    record = json.loads(again)
    assert (status, record["key"], record["champion"]) == (0, out.strip(), True)
    assert record["training"][0]["log"] == "healthy1"


def test_run_prints_the_verdicts(
    capsys: pytest.CaptureFixture[str],
    logs: Path,
    fitted: list[str | Path],
    tmp_path: Path,
    detector: Detector,
) -> None:
    status, out, err = call(capsys, "run", logs, *fitted, "--out", tmp_path / "out")
    assert status == 0
    table = {line.split()[0]: line.split()[2] for line in out.splitlines()}
    assert table == {
        "log": "fault", "faulty": "maf_gain", "healthy1": "none", "healthy2": "none",
    }  # fmt: skip
    assert "[3/3] healthy2: none" in err
    short = detector.key[:10]
    status, out, _ = call(
        capsys, "run", logs, *fitted, "--out", tmp_path / "out", "--json", "--detector", short
    )
    rows = json.loads(out)
    assert status == 0
    assert [r["fault"] for r in rows] == ["maf_gain", "none", "none"]
    assert rows == pl.read_parquet(tmp_path / "out" / "summary.parquet").to_dicts()


def test_one_failed_log_is_exit_1_and_the_rest_is_done(
    capsys: pytest.CaptureFixture[str], logs: Path, fitted: list[str | Path], tmp_path: Path
) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    paths = (tmp_path / "bad.parquet", logs / "faulty.parquet", tmp_path / "gone.csv")
    status, out, err = call(capsys, "run", *paths, *fitted, "--out", tmp_path / "out", "--json")
    assert status == 1
    assert [(r["log"], r["status"]) for r in json.loads(out)] == [
        ("bad", "failed"), ("faulty", "ok"), ("gone", "failed"),
    ]  # fmt: skip
    assert "[1/3] bad: bad.parquet" in err
    assert (tmp_path / "out" / "faulty" / "verdict.json").exists()


def test_debug_shows_why_a_log_failed(
    capsys: pytest.CaptureFixture[str], fitted: list[str | Path], tmp_path: Path
) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    words = [
        "run",
        str(tmp_path / "bad.parquet"),
        *map(str, fitted),
        "--out",
        str(tmp_path / "out"),
        "--debug",
    ]
    assert main(words) == 1
    assert "Traceback" in capsys.readouterr().err


def test_run_lists_all_problems_in_order_and_starts_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "store").touch()
    (tmp_path / "map.toml").write_text("[signals.p_Bst]\nsorce = 'x'\n")
    status, out, err = call(
        capsys, "run", tmp_path / "gone.csv", "--recipe", "diesel", "--store", tmp_path / "store",
        "--map", tmp_path / "map.toml", "--out", tmp_path / "out",
    )  # fmt: skip
    assert (status, out) == (2, "")
    places = [err.index(word) for word in ("no recipe 'diesel'", "'sorce'", "is not a folder", "gone.csv")]
    assert places == sorted(places)
    assert not (tmp_path / "out").exists()


def test_fit_lists_all_problems_in_order_and_starts_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "store").touch()
    status, out, err = call(
        capsys, "fit", tmp_path / "gone.csv", "--calibrate", tmp_path / "lost.csv", "--recipe", "diesel",
        "--store", tmp_path / "store",
    )  # fmt: skip
    assert (status, out) == (2, "")
    places = [err.index(word) for word in ("no recipe 'diesel'", "is not a folder", "gone.csv", "lost.csv")]
    assert places == sorted(places)


def test_fit_lists_every_log_that_cannot_be_read(
    capsys: pytest.CaptureFixture[str], logs: Path, tmp_path: Path
) -> None:
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    status, out, err = call(
        capsys, "fit", logs / "healthy1.parquet", tmp_path / "bad.parquet", tmp_path / "gone.csv",
        "--recipe", "diesel_airpath", "--store", tmp_path / "store",
    )  # fmt: skip
    assert (status, out) == (2, "")
    assert "bad.parquet" in err
    assert "gone.csv" in err
    assert not (tmp_path / "store").exists()


def test_detector_that_is_not_there(
    capsys: pytest.CaptureFixture[str], logs: Path, store: Store, tmp_path: Path
) -> None:
    words = ("run", logs, "--recipe", "diesel_airpath", "--out", tmp_path / "out", "--store")
    assert call(capsys, *words, tmp_path / "empty")[0] == 2
    status, _, err = call(capsys, *words, store.folder, "--detector", "nonesuch")
    assert status == 2
    assert "has no detector 'nonesuch'" in err
    assert not (tmp_path / "out").exists()


def test_a_recipe_that_was_changed_since_the_fit(
    capsys: pytest.CaptureFixture[str], logs: Path, store: Store, tmp_path: Path
) -> None:
    recipe = tmp_path / "diesel_airpath.toml"
    recipe.write_text(recipe_text("diesel_airpath"), encoding="utf-8")
    words = ("run", logs / "faulty.parquet", "--recipe", recipe, "--store", store.folder, "--no-timeline")
    assert call(capsys, *words, "--out", tmp_path / "out")[0] == 0
    recipe.write_text(recipe.read_text().replace("min_evidence_s = 45", "min_evidence_s = 46"))
    status, _, err = call(capsys, *words, "--out", tmp_path / "other")
    assert status == 2
    assert "min_evidence_s" in err
    assert not (tmp_path / "other").exists()


def test_missing_signal_is_told_with_near_names(
    capsys: pytest.CaptureFixture[str], healthy: list[Log], tmp_path: Path
) -> None:
    frame = healthy[0].groups["ecu"].frame.rename({"p_Bst": "p_Boost"})
    write_log(replace(healthy[0], groups={"ecu": Group("ecu", frame)}), tmp_path / "x.parquet")
    words = ("fit", tmp_path / "x.parquet", "--recipe", "diesel_airpath", "--store", tmp_path / "store")
    status, out, err = call(capsys, *words)
    assert (status, out) == (2, "")
    assert "no signal 'p_Bst'; did you mean p_Boost" in err
    with pytest.raises(ValueError, match="p_Boost"):  # the traceback, for those who ask for it
        main([*map(str, words), "--debug"])


def test_recipe_show_prints_what_check_takes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    status, out, err = call(capsys, "recipe", "show", "diesel_airpath")
    assert (status, err) == (0, "")
    (tmp_path / "mine.toml").write_text(out, encoding="utf-8")
    status, out, _ = call(capsys, "recipe", "check", tmp_path / "mine.toml")
    assert status == 0
    assert out.startswith("recipe mine: no mistakes")
    (tmp_path / "mine.toml").write_text("[[stage]]\nuse = 'alin'\n[[stage]]\nuse = 'gaet'\n")
    status, out, err = call(capsys, "recipe", "check", tmp_path / "mine.toml")
    assert (status, out) == (2, "")
    assert "did you mean align" in err
    assert "did you mean gate" in err


def test_recipe_list_names_the_built_in_ones(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(capsys, "recipe", "list")
    assert status == 0
    assert {"diesel_airpath", "si_airpath"} <= {line.split()[0] for line in out.splitlines()}


def test_simulate_tells_the_truth(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    status, out, _ = call(
        capsys, "simulate", "airpath", "--out", path, "--cycle", "udds", "--duration", "20",
        "--fault", "maf_gain", "--magnitude", "-0.05", "--onset", "5",
        "--fault", "boost_leak", "--magnitude", "4",
    )  # fmt: skip
    assert (status, out) == (0, "")
    status, out, _ = call(capsys, "inspect", path, "--json")
    events = json.loads(out)["events"]
    assert [(e["kind"], e["magnitude"], round(e["t_start"], 3)) for e in events] == [
        ("maf_gain", -0.05, 5.0),
        ("boost_leak", 4.0, 6.667),
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--fault", "maf_gain"], "1 --fault but 0 --magnitude"),
        (["--magnitude", "1"], "more --magnitude than --fault"),
        (["--fault", "maf_gian", "--magnitude", "0.1"], "did you mean maf_gain"),
        (["--set", "CdA=big"], "expected name=value"),
        (["--set", "cda=1"], "unknown parameter 'cda'"),
        (["--cycle", "wltx"], "wltx"),
    ],
)
def test_simulate_mistakes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], message: str
) -> None:
    status, _, err = call(capsys, "simulate", "airpath", "--out", tmp_path / "x.csv", *words)
    assert status == 2
    assert message in err
    assert not (tmp_path / "x.csv").exists()


def test_a_reader_that_goes_away_is_no_error() -> None:
    code = "import sys; from pipeline.cli import main; sys.exit(main(['recipe', 'show', 'diesel_airpath']))"
    command = f'{sys.executable} -c "{code}" | head -c 1; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_another_package_of_the_same_name_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "__init__.py").touch()
    lines = (
        "import sys",
        f"sys.path.insert(0, {str(tmp_path)!r})",
        "from pipeline.cli import main",
        "sys.exit(main(['recipe', 'list']))",
    )
    words = [sys.executable, "-c", "\n".join(lines)]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2
    assert f"package 'stages' is loaded from {tmp_path}" in done.stderr
    assert "Traceback" not in done.stderr
