from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ingest.errors import StoreError
from ingest.log import Log
from pipeline import diagnose, fit
from pipeline.detector import Detector, check_recipe, load_detector, load_record, save_detector
from pipeline.diagnosing import supposed
from pipeline.recipe import Recipe, build_recipe
from pipeline.records import key_of, seal
from stages.detect import Detect
from stages.isolate import Isolate
from stages.select_inputs import SelectInputs


@pytest.fixture
def kept(detector: Detector, tmp_path: Path) -> Path:
    """A folder with the detector, to be damaged."""
    save_detector(detector, tmp_path)
    return tmp_path


def rewrite(path: Path, change: Callable[[dict[str, Any]], None], rekey: bool = False) -> str:
    """Change a record; ``rekey`` makes it consistent again, as a forger would."""
    record = json.loads(path.read_text())
    change(record)
    if rekey:
        record["key"] = key_of(record)
        record["seal"] = seal(record)
    path.unlink()
    path = path.with_name(f"{record['key']}.json")
    path.write_text(json.dumps(record))
    return str(record["key"])


def test_round_trip_gives_the_same_diagnosis_to_the_bit(detector: Detector, faulty: Log, kept: Path) -> None:
    again = load_detector(kept, detector.key)
    assert again.record == detector.record
    assert again.recipe == detector.recipe
    one, two = diagnose(faulty, detector), diagnose(faulty, again)
    assert one.samples.equals(two.samples, null_equal=True)
    assert one.verdict == two.verdict
    assert one.verdict.fault == "maf_gain"


def test_key_depends_on_what_was_learned_and_from_what(
    detector: Detector, healthy: list[Log], recipe: Recipe
) -> None:
    assert fit(healthy[:1], recipe, healthy[1:]).key == detector.key  # not on time
    renamed = [replace(healthy[0], name="other")]
    assert fit(renamed, recipe, healthy[1:]).key != detector.key


def test_record_says_from_what(detector: Detector) -> None:
    (training,), (calibration,) = detector.record["training"], detector.record["calibration"]
    assert (training["log"], calibration["log"]) == ("healthy1", "healthy2")
    assert (training["start_s"], training["end_s"]) == (0.0, 399.98)
    assert detector.record["recipe"] == "diesel_airpath"
    assert set(detector.record["versions"]) == set(detector.recipe.versions())


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_truncated(kept: Path, detector: Detector, suffix: str, share: float) -> None:
    path = kept / f"{detector.key}{suffix}"
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(StoreError, match=r"cannot be read: .*; fit the detector again"):
        load_detector(kept, detector.key)


def test_every_damaged_byte_of_the_arrays_is_noticed(kept: Path, detector: Detector) -> None:
    """Or changes nothing, as in the date of a zip entry: what is loaded is always what was learned."""
    path = kept / f"{detector.key}.npz"
    content, refused = path.read_bytes(), 0
    rng = np.random.default_rng(0)
    places = [*range(60), *range(len(content) - 60, len(content)), *rng.integers(0, len(content), 150)]
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            loaded = load_detector(kept, detector.key)
        except StoreError:
            refused += 1
        else:
            for name, array in detector.arrays.items():
                np.testing.assert_array_equal(loaded.arrays[name], array)
    assert refused > 0.6 * len(places)


def test_missing_files(kept: Path, detector: Detector) -> None:
    (kept / f"{detector.key}.npz").unlink()
    with pytest.raises(StoreError, match=r"\.npz cannot be read"):
        load_detector(kept, detector.key)
    with pytest.raises(StoreError, match=r"abc\.json cannot be read"):
        load_detector(kept, "abc")


def test_arrays_of_another_detector(kept: Path, detector: Detector) -> None:
    path = kept / f"{detector.key}.npz"
    with np.load(path) as file:
        arrays = dict(file)
    name = next(k for k in arrays if k.endswith("/threshold"))
    np.savez_compressed(path, **{**arrays, name: arrays[name] + 100})
    with pytest.raises(StoreError, match="are not those of its record"):
        load_detector(kept, detector.key)


def test_pickled_arrays_are_not_executed(kept: Path, detector: Detector) -> None:
    np.savez(kept / f"{detector.key}.npz", x=np.array([Detect()], dtype=object))
    with pytest.raises(StoreError, match="cannot be read"):
        load_detector(kept, detector.key)


def test_changed_record(kept: Path, detector: Detector) -> None:
    rewrite(kept / f"{detector.key}.json", lambda r: r.update(training=[]))
    with pytest.raises(StoreError, match="was changed after it was written"):
        load_record(kept / f"{detector.key}.json")


@pytest.mark.parametrize("text", ["[]", "[1]", "5", "null", "{}", '"x"', '{"key": 1}'])
def test_record_that_is_none(kept: Path, detector: Detector, text: str) -> None:
    (kept / f"{detector.key}.json").write_text(text)
    with pytest.raises(StoreError, match="fit the detector again"):
        load_detector(kept, detector.key)


def test_record_under_another_name(kept: Path, detector: Detector) -> None:
    (kept / f"{detector.key}.json").rename(kept / "other.json")
    with pytest.raises(StoreError, match="was changed"):
        load_record(kept / "other.json")


@pytest.mark.parametrize(
    ("version", "way_out"),
    [(99, "take a newer version"), (1, "fit the detector again on healthy1"), (None, "fit")],
)
def test_other_format(kept: Path, detector: Detector, version: int | None, way_out: str) -> None:
    key = rewrite(kept / f"{detector.key}.json", lambda r: r.update(format=version), rekey=True)
    with pytest.raises(
        StoreError, match=f"has format {version}, this version of dynoscope reads 2; {way_out}"
    ):
        load_detector(kept, key)


@pytest.mark.parametrize("what", ["notes", "created", "packages"])
def test_what_the_key_does_not_cover_is_sealed(kept: Path, detector: Detector, what: str) -> None:
    rewrite(kept / f"{detector.key}.json", lambda r: r.update({what: "another"}))
    with pytest.raises(StoreError, match="was changed after it was written"):
        load_record(kept / f"{detector.key}.json")


def test_record_says_what_was_learned(detector: Detector) -> None:
    record = detector.record
    assert {"log": "healthy1", "seed": 1}.items() <= record["training"][0].items()
    assert len(record["training"][0]["sha256"]) == 64
    assert record["training"][0]["sha256"] != record["calibration"][0]["sha256"]
    assert set(record["thresholds"]["50 s"]) == set(supposed(detector.recipe))
    assert 0 < record["scores"]["sigma"]["r_cyl"] < 0.05
    assert 0 < record["scores"]["rms"]["f_Cyl"] < 2.0
    place = next(i for i, s in enumerate(detector.recipe.stages) if isinstance(s, SelectInputs))
    assert record["seeds"] == {f"{place}.search.seed": 0}
    assert record["packages"]["numpy"] == np.__version__


def test_other_stage_version(kept: Path, detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Isolate, "version", "next")
    with pytest.raises(StoreError, match=r"another version of \d+\.isolate; fit it again"):
        load_detector(kept, detector.key)


def test_recipe_that_this_version_does_not_take(kept: Path, detector: Detector) -> None:
    def unknown_setting(record: dict[str, Any]) -> None:
        record["definition"]["stage"][0]["colour"] = "red"

    key = rewrite(kept / f"{detector.key}.json", unknown_setting, rekey=True)
    (kept / f"{detector.key}.npz").rename(kept / f"{key}.npz")
    with pytest.raises(StoreError, match=r"(?s)does not take.*'colour'"):
        load_detector(kept, key)


def test_a_changed_recipe_is_not_passed_over(detector: Detector, recipe: Recipe) -> None:
    check_recipe(detector, recipe)
    definition = recipe.to_json()
    definition["stage"][0]["max_gap_s"] = 9.0
    definition["min_evidence_s"] = 1.0
    with pytest.raises(StoreError, match=r"another recipe .*\(min_evidence_s; align.max_gap_s\)"):
        check_recipe(detector, build_recipe(recipe.name, definition))
