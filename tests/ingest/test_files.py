from __future__ import annotations

import hashlib
from pathlib import Path

import polars as pl
import pytest

from ingest import read_log, write_log
from ingest.errors import LogError
from ingest.files import find_logs, group_file, unique_stems
from ingest.log import Group, Log
from ingest.readers import FORMATS, reader
from ingest.recording import WRITERS


@pytest.fixture
def log() -> Log:
    return Log("x", {"g": Group("g", pl.DataFrame({"time": [0.0, 1.0], "a": [1.0, 2.0]}))})


def test_found_by_content_not_by_name(tmp_path: Path, log: Log) -> None:
    for suffix in WRITERS:
        path = write_log(log, tmp_path / f"x{suffix}")
        assert read_log(path.rename(tmp_path / f"{suffix[1:]}.dat")).values("a").tolist() == [1.0, 2.0]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_keeps_the_contract(name: str, tmp_path: Path, log: Log) -> None:
    module = reader(name)
    assert all(callable(getattr(module, f)) for f in ("is_mine", "header", "read"))
    assert module.__doc__
    for other in WRITERS:
        head = write_log(log, tmp_path / f"x{other}").read_bytes()[:4096]
        assert module.is_mine(tmp_path / "x", head) == (WRITERS[other] == name)


def test_facts_of_a_file_of_others(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text("time,a\n0,1\n")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert read_log(str(path)).facts == {"file": "bench.csv", "format": "csv", "sha256": digest}


def test_a_map_as_a_path_applies_to_our_own_files_too(tmp_path: Path, log: Log) -> None:
    path = write_log(log, tmp_path / "x.mcap")
    names = tmp_path / "m.toml"
    names.write_text('[signals.p_Bst]\nsource = "a"\nunit = "bar"\n')
    assert read_log(path, names).values("p_Bst").tolist() == [100.0, 200.0]


def test_written_whole_or_not_at_all(tmp_path: Path, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_log(log, tmp_path / "new" / "x.mcap")
    before = path.read_bytes()
    monkeypatch.setattr("ingest.mcap_writer.McapWriter.finish", lambda self: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_log(log, path)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["x.mcap"]


def test_what_cannot_be_written_or_read(tmp_path: Path, log: Log) -> None:
    with pytest.raises(LogError, match=r"cannot write '\.mcpa' files; did you mean \.mcap"):
        write_log(log, tmp_path / "x.mcpa")
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match=r"x\.mcap cannot be written"):
        write_log(log, tmp_path / "file" / "x.mcap")
    write_log(log, tmp_path / "drive.mcap")
    with pytest.raises(LogError, match=r"there is no such file; did you mean drive\.mcap\?"):
        read_log(tmp_path / "drvie.mcap")
    with pytest.raises(LogError, match="is a folder"):
        read_log(tmp_path)


def test_find_logs(tmp_path: Path, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("b.mcap", "a.csv", "sub/c.parquet", "sub/deep/d.mcap"):
        write_log(log, tmp_path / name)
    for name in ("notes.md", "sub/report.json", ".hidden.csv"):
        (tmp_path / name).write_text("")
    Path("list.txt").write_text("# ours\nb.mcap\n\nsub\n")

    def found(*patterns: str) -> list[str]:
        return [str(p) for p in find_logs(patterns)]

    assert [Path(p).name for p in found(str(tmp_path))] == ["a.csv", "b.mcap"]
    assert found("sub", "b.mcap", "sub/c.parquet") == ["sub/c.parquet", "b.mcap"]
    assert found("**/*.mcap") == ["b.mcap", "sub/deep/d.mcap"]
    assert found("@list.txt") == ["b.mcap", "sub/c.parquet"]
    assert found(Path("b.mcap").absolute().as_uri()) == [str(tmp_path / "b.mcap")]
    assert found("b.mcap", "nope.csv") == ["b.mcap", "nope.csv"], "reading it will fail, and the rest is done"
    Path("empty").mkdir()
    with pytest.raises(LogError) as caught:
        found("b.mcpa", "*.mf4", "empty", "@none.txt", "nosuch://a/b", "there/x.csv")
    for words in (
        "b.mcpa: there is no such file; did you mean b.mcap?",
        "*.mf4: no file fits",
        "empty: no logs in this folder",
        "@none.txt: the list cannot be read",
        "nosuch://a/b cannot be read",
        "there/x.csv: there is no folder there",
    ):
        assert words in str(caught.value)


def test_names_of_outputs(tmp_path: Path) -> None:
    paths = [
        tmp_path / "a" / "x.csv",
        tmp_path / "b" / "x.csv",
        tmp_path / "y.csv",
        tmp_path / "gone" / "x.csv",
    ]
    for i, path in enumerate(paths[:3]):
        path.parent.mkdir(exist_ok=True)
        path.write_text(str(i))
    digests = [hashlib.sha256(str(i).encode()).hexdigest()[:8] for i in range(2)]
    assert unique_stems(paths) == [f"x-{digests[0]}", f"x-{digests[1]}", "y", "x"]
    assert group_file("../x:y") == "%2E.%2Fx%3Ay.parquet"
