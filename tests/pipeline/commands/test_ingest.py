from __future__ import annotations

import json
from pathlib import Path

import pytest

from ingest import read_log
from ingest.files import read_header
from pipeline.cli import main


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "a.csv").write_text("Zeit;pic;x\nms;Pa;V\n0;100000;1\n100;101000;2\n")
    (folder / "b.csv").write_text("Zeit;pic;x\nms;K;V\n0;1;1\n")
    (folder / "map.toml").write_text('[signals.p_Bst]\nsource = "pic"\n')
    return folder


def test_ingest_writes_both_forms_and_a_report(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = bench.parent / "out"
    argv = ["ingest", str(bench / "a.csv"), "--out", str(out), "--map", str(bench / "map.toml"), "--json"]
    assert main(argv) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["log"], row["status"], row["rows"], row["signals"], row["seconds"]) == ("a", "ok", 2, 2, 0.1)
    expected = read_log(bench / "a.csv", bench / "map.toml")
    assert expected.values("p_Bst").tolist() == [100.0, 101.0]
    assert [Path(f).relative_to(out).as_posix() for f in row["files"]] == [
        "a.mcap",
        "a/data.parquet",
        "a/report.json",
    ]
    assert read_log(out / "a.mcap").equals(expected)
    assert read_log(out / "a" / "data.parquet").equals(expected)
    report = json.loads((out / "a" / "report.json").read_text())
    assert report["signals"]["p_Bst"]["source_unit"] == "Pa"


def test_one_bad_log_does_not_stop_the_rest(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = bench.parent / "out"
    argv = ["ingest", str(bench), "nope.csv", "--out", str(out), "--map", str(bench / "map.toml")]
    assert main(argv) == 1
    printed = capsys.readouterr()
    status = {line.split()[0]: line.split()[1] for line in printed.out.splitlines()[1:]}
    assert status == {"a": "ok", "b": "failed", "nope": "failed"}
    assert "channel 'pic' (signal p_Bst): unit 'K' is temperature" in printed.out
    assert (out / "a.mcap").exists()
    assert not (out / "b.mcap").exists()
    assert not (out / "b").exists()


@pytest.mark.parametrize(
    ("logs", "names", "words"),
    [("a.csv", "[signals.p_Bst]\nsorce = 1\n", "'sorce'"), ("nope.csv", "", "no such file")],
)
def test_nothing_is_started(
    bench: Path, capsys: pytest.CaptureFixture[str], logs: str, names: str, words: str
) -> None:
    (bench / "map.toml").write_text(names)
    out = bench.parent / "out"
    argv = ["ingest", str(bench / logs), "--out", str(out), "--map", str(bench / "map.toml")]
    assert main(argv) == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_inspect_of_a_whole_log(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(bench / "a.csv")
    assert main(["inspect", path, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["checked"] == "whole file"
    assert report["signals"]["pic"]["unit"] == "Pa"
    assert main(["inspect", path, "--map", str(bench / "map.toml")]) == 0
    printed = capsys.readouterr().out
    assert "p_Bst   data   kPa" in printed
    assert main(["inspect", str(bench / "nope")]) == 2


def test_inspect_of_a_large_log_reads_the_header_only(
    bench: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.commands.inspect.WHOLE_BYTES", 10)
    path = bench / "a.csv"
    assert main(["inspect", str(path), "--json"]) == 0
    printed = capsys.readouterr()
    assert "--full" in printed.err
    report = json.loads(printed.out)
    assert (report["checked"], report["span_s"]) == ("header", None)
    assert list(report["signals"]) == list(read_header(path).signals)
    assert main(["inspect", str(path), "--json", "--full"]) == 0
    assert json.loads(capsys.readouterr().out)["checked"] == "whole file"


def test_inspect_proposes_a_map_and_applies_nothing(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, saved = bench / "c.csv", bench / "proposed.toml"
    path.write_text("time;Ladedruck;engine speed\ns;mbar;U/min\n0;1500;900\n1;1510;910\n")
    assert main(["inspect", str(path), "--json", "--save-map", str(saved)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["proposed"] == {"p_Bst": "Ladedruck", "n_Eng": "engine speed"}
    assert list(report["signals"]) == ["Ladedruck", "engine speed"]
    assert read_log(path, saved).values("p_Bst").tolist() == [150.0, 151.0]
    assert main(["inspect", str(path), "--save-map", str(saved)]) == 2
    assert "is there already" in capsys.readouterr().err


def test_rate_and_join(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("1,2\n3,4\n")
    argv = ["ingest", str(tmp_path), "--out", str(tmp_path / "out"), "--rate", "10", "--join", "--json"]
    assert main(argv) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["log"], row["rows"], row["seconds"]) == ("a", 4, pytest.approx(0.3))
    assert main(["inspect", str(tmp_path / "a.csv"), "--rate", "-1"]) == 2
    assert "--rate is -1" in capsys.readouterr().err
