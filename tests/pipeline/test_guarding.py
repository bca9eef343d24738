"""Sets of seven short drives, some with a fault from their start."""

from __future__ import annotations

from pathlib import Path

import pytest

from ingest import write_log
from ingest.log import Log
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from pipeline import fit
from pipeline.cli import main
from pipeline.fitting import learn, sections, suspicious
from pipeline.guarding import Finding
from pipeline.recipe import Recipe
from pipeline.template import bound, common_signals
from stages.stage import transform


def drive(seed: int, fault: Fault | None = None) -> Log:
    faults = [fault] if fault else []
    return simulate_airpath(cycle="udds", duration_s=250, seed=seed, faults=faults, name=f"drive{seed}")


MAF = Fault(name="maf_gain", magnitude=0.06, onset_s=0.0)
LEAK = Fault(name="boost_leak", magnitude=7.0, onset_s=0.0)


@pytest.fixture(scope="module")
def clean() -> list[Log]:
    return [drive(seed) for seed in range(20, 27)]


def findings(logs: list[Log], recipe: Recipe) -> dict[str, Finding]:
    """What the guard of a fit finds, without the fit."""
    prepare, models, decide = sections(bound(recipe, common_signals(logs)).stages)
    blocks = [transform(prepare, log) for log in logs]
    fitted = learn(models, [(prepare, block) for block in blocks])
    found = suspicious([*prepare, *fitted], decide, blocks, len(prepare))
    return {f.log: f for f in found if f}


@pytest.mark.parametrize("fault", [MAF, LEAK], ids=lambda f: str(f.name))
def test_poisoned_logs_are_named_with_the_fault_and_its_size(
    clean: list[Log], recipe: Recipe, fault: Fault
) -> None:
    found = findings([drive(20, fault), clean[1], drive(22, fault), *clean[3:]], recipe)
    assert set(found) == {"drive20", "drive22"}
    assert {f.fault for f in found.values()} == {fault.name}
    assert all(f.size == pytest.approx(fault.magnitude, rel=0.25) for f in found.values())


def test_clean_logs_are_all_taken(clean: list[Log], recipe: Recipe) -> None:
    assert findings(clean, recipe) == {}


def test_a_fit_leaves_them_out_of_training_and_calibration(clean: list[Log], recipe: Recipe) -> None:
    said: list[str] = []
    detector = fit([drive(20, MAF), *clean[1:5]], recipe, [clean[5], drive(26, MAF)], said.append)
    assert {f["log"] for f in detector.record["left_out"]} == {"drive20", "drive26"}
    assert [s["log"] for s in detector.record["training"]] == ["drive21", "drive22", "drive23", "drive24"]
    assert [s["log"] for s in detector.record["calibration"]] == ["drive25"]
    assert "do not agree with the others: drive2" in detector.record["notes"][0]
    assert detector.record["notes"][0] in said
    without = fit(clean[1:5], recipe, clean[5:6])
    assert without.record["arrays_sha256"] == detector.record["arrays_sha256"]


def test_too_many_suspicious_logs_are_refused(
    clean: list[Log], recipe: Recipe, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three kinds of fault in four of seven logs: no two of them agree."""
    faults = [MAF, LEAK, Fault(name="intake_pressure_gain", magnitude=0.04, onset_s=0.0),
              Fault(name="maf_gain", magnitude=-0.07, onset_s=0.0)]  # fmt: skip
    logs = [*(drive(20 + i, f) for i, f in enumerate(faults)), *clean[4:]]
    for log in logs:
        write_log(log, tmp_path / "logs" / f"{log.name}.parquet")
    words = ["fit", str(tmp_path / "logs"), "--recipe", "diesel_airpath", "--store", str(tmp_path / "store")]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "of 7 logs do not agree with the others, too many" in said
    assert "drive20 (maf_gain" in said
    assert not list((tmp_path / "store").glob("*.npz"))
    assert len(fit(logs[:6], recipe, logs[6:], trust=True).record["training"]) == 6
