from __future__ import annotations

import json
from pathlib import Path

import pytest

from ingest.errors import StoreError
from pipeline.detector import Detector
from pipeline.store import Store

NAME = "diesel_airpath"


@pytest.fixture
def two(detector: Detector, second: Detector, tmp_path: Path) -> Store:
    store = Store(tmp_path / "store")
    assert store.add(detector)
    assert not store.add(second)
    return store


def test_the_first_is_champion_until_another_is_promoted(
    two: Store, detector: Detector, second: Detector
) -> None:
    assert two.get(NAME).key == detector.key
    two.promote(second.key, NAME, "better")
    assert two.get(NAME).key == second.key
    history = json.loads((two.folder / "champions" / f"{NAME}.json").read_text())
    assert [(e["key"], e["reason"]) for e in history] == [
        (detector.key, "first of its recipe"),
        (second.key, "better"),
    ]
    assert not two.add(detector)  # kept again, but no longer champion
    assert two.champion(NAME) == second.key


def test_adding_twice_changes_nothing(two: Store, detector: Detector) -> None:
    before = {p: p.read_bytes() for p in two.folder.rglob("*") if p.is_file()}
    two.add(detector)
    assert {p: p.read_bytes() for p in two.folder.rglob("*") if p.is_file()} == before


def test_by_key_and_its_beginning(two: Store, detector: Detector, second: Detector) -> None:
    assert two.get(NAME, second.key).key == second.key
    length = next(i for i in range(1, 33) if detector.key[:i] != second.key[:i])
    assert two.resolve(second.key[:length]) == second.key
    if length > 1:
        with pytest.raises(StoreError, match="several begin so"):
            two.resolve(second.key[: length - 1])


def test_key_that_several_begin_with(two: Store, detector: Detector) -> None:
    twin = two.folder / f"{detector.key[:-1]}_.json"
    twin.write_text("{}")
    with pytest.raises(StoreError, match=f"several begin so: .*{twin.stem}"):
        two.resolve(detector.key[:8])


@pytest.mark.parametrize("key", ["", "zzz", "../champions/diesel_airpath"])
def test_unknown_key_lists_the_known(two: Store, detector: Detector, key: str) -> None:
    with pytest.raises(StoreError, match=f"has no detector '{key}'; .*{detector.key}"):
        two.get(NAME, key)


def test_records_are_in_order_of_time_and_drafts_no_records(two: Store) -> None:
    (two.folder / ".abc.123.json").write_text("half a rec")
    records = two.records()
    assert len(records) == 2
    assert records == sorted(records, key=lambda r: r["created"])


def test_empty_store_says_how_to_fill_it(tmp_path: Path) -> None:
    with pytest.raises(
        StoreError, match=f"no detector of recipe '{NAME}', but of: none; fit one: dynoscope fit"
    ):
        Store(tmp_path / "nowhere").get(NAME)


def test_recipe_without_detector_names_those_that_have(two: Store, detector: Detector) -> None:
    with pytest.raises(StoreError, match=f"'si_airpath', but of: {NAME}"):
        two.get("si_airpath")
    with pytest.raises(StoreError, match=f"is of recipe '{NAME}', not 'si_airpath'"):
        two.get("si_airpath", detector.key)


def test_store_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(StoreError, match="is not a folder"):
        Store(tmp_path / "x")


def test_store_that_cannot_be_written(tmp_path: Path, detector: Detector) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(StoreError, match="cannot be written"):
        Store(tmp_path / "x" / "store").add(detector)


@pytest.mark.parametrize("text", ["", "{}", "[]", "[{}]", "5", "null", '["x"]', '[{"key": 3}]', "[{"])
def test_damaged_champion_pointer(two: Store, text: str, second: Detector) -> None:
    pointer = two.folder / "champions" / f"{NAME}.json"
    pointer.write_text(text)
    with pytest.raises(StoreError, match=r"champion pointer .* cannot be read"):
        two.get(NAME)
    with pytest.raises(StoreError, match="champion pointer"):
        two.add(second)  # it must not become champion unasked
    assert pointer.read_text() == text
    assert two.get(NAME, second.key).key == second.key


def test_champion_whose_files_are_gone(two: Store, detector: Detector) -> None:
    (two.folder / f"{detector.key}.json").unlink()
    with pytest.raises(StoreError, match=f"{detector.key}.json cannot be read"):
        two.get(NAME)
