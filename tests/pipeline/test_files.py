from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.files import aside, write_aside


def test_replaces_whole_and_makes_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "new" / "x.json"
    for content in (b"one", b"two"):
        write_aside(path, content)
        assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path]


def test_a_failure_keeps_the_old_file_and_leaves_no_draft(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(b"old")

    def crash() -> None:
        with aside(path) as draft:
            draft.write_bytes(b"half")
            assert path.read_bytes() == b"old"
            raise RuntimeError

    with pytest.raises(RuntimeError):
        crash()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_draft_has_the_suffix(tmp_path: Path) -> None:
    with aside(tmp_path / "x.parquet") as draft:
        assert draft.suffix == ".parquet"
        draft.touch()
