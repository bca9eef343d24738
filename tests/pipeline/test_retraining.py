from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ingest.errors import StoreError
from ingest.log import Log
from ingest.simulators.airpath import simulate_airpath
from pipeline import diagnose
from pipeline.detector import Detector, load_detector, save_detector
from pipeline.fitting import gathered
from pipeline.retraining import continue_champion, split
from stages.continuing import continued
from stages.relations import Relations
from stages.stage import transform


@pytest.fixture(scope="module")
def new() -> list[Log]:
    return [simulate_airpath(cycle="us06", duration_s=300, seed=seed, name=f"new{seed}") for seed in (31, 32)]


@pytest.fixture(scope="module")
def warm(detector: Detector, new: list[Log]) -> Detector:
    return continue_champion(detector, new)


def test_the_champion_goes_on_learning(detector: Detector, warm: Detector, new: list[Log]) -> None:
    assert [s["log"] for s in warm.record["training"]] == ["healthy1", "new31", "new32"]
    assert warm.record["calibration"] == detector.record["calibration"]
    assert "thresholds are the champion's" in warm.record["notes"][0]
    assert (warm.record["challenges"], warm.record["how"]) == (detector.key, "continued")
    known = [diagnose(new[0], d).samples["in_domain"].mean() for d in (detector, warm)]
    assert known[1] > known[0]  # type: ignore[operator]
    assert diagnose(new[0], warm).verdict.fault == "none"


def test_it_is_the_fit_on_all_logs_at_once(
    detector: Detector, warm: Detector, healthy: list[Log], new: list[Log]
) -> None:
    """On the champion's maps."""
    place = next(i for i, s in enumerate(detector.stages) if isinstance(s, Relations))
    before, relations = detector.stages[:place], detector.stages[place]
    assert isinstance(relations, Relations)
    blocks = [transform(before, log) for log in (healthy[0], *new)]
    at_once = continued(relations, gathered(detector.stages, before, blocks)).learned
    one = warm.stages[place]
    assert isinstance(one, Relations)
    for name, array in at_once.items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(one.learned[name], array, rtol=1e-8, atol=1e-9, err_msg=name)


def test_in_two_steps_through_the_store(
    detector: Detector, warm: Detector, new: list[Log], tmp_path: Path
) -> None:
    folder = tmp_path
    save_detector(continue_champion(detector, new[:1]), folder)
    (path,) = folder.glob("*.json")
    two = continue_champion(load_detector(folder, path.stem), new[1:])
    assert two.arrays.keys() == warm.arrays.keys()
    for name, array in warm.arrays.items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(two.arrays[name], array, rtol=1e-8, atol=1e-9, err_msg=name)


def test_damaged_sums_are_refused(detector: Detector, tmp_path: Path) -> None:
    folder = tmp_path
    save_detector(detector, folder)
    path = folder / f"{detector.key}.sums.npz"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StoreError, match=r"sums\.npz cannot be read"):
        load_detector(folder, detector.key)


def test_no_part_of_a_log_is_learned_from_twice(detector: Detector, healthy: list[Log]) -> None:
    with pytest.raises(StoreError, match="has learned from it already"):
        continue_champion(detector, healthy[:1])
    of_file = replace(healthy[1], facts={"sha256": "ab" * 32})
    first = continue_champion(detector, [of_file.between(0.0, 200.0)])
    with pytest.raises(StoreError, match=r"'healthy2': champion .* has learned from it already"):
        continue_champion(first, [of_file.between(100.0, 300.0)])
    rest = continue_champion(first, [of_file.between(200.0, 400.0)])
    assert len(rest.record["training"]) == 3


def test_a_champion_without_sums(detector: Detector, new: list[Log]) -> None:
    with pytest.raises(StoreError, match="retrain without --warm"):
        continue_champion(replace(detector, sums={}), new)


def test_the_last_30_percent_are_held_out(healthy: list[Log]) -> None:
    (training,), (held_out,) = split(healthy[:1])
    assert training.span == pytest.approx((0.0, 279.98), abs=0.05)
    assert held_out.span == pytest.approx((280.0, 399.98), abs=0.05)
