from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from ingest import write_log
from ingest.errors import LogError, RecipeError
from ingest.log import Log
from ingest.simulators.airpath import simulate_airpath
from ingest.simulators.faults import Fault
from pipeline.adapting import adapt
from pipeline.cli import main
from pipeline.detector import Detector
from pipeline.store import Store
from pipeline.summary import summary_frame
from pipeline.wear import wear_of_batch


@pytest.fixture(scope="module")
def drives() -> list[Log]:
    """Six healthy drives, and four with a sensor that reads 8 % low."""
    fault = Fault(name="maf_gain", magnitude=-0.08, onset_s=0.0)
    return [
        simulate_airpath(
            cycle="udds", duration_s=250, seed=80 + i, faults=[fault] if i >= 6 else [], name=f"day{i}"
        )
        for i in range(10)
    ]


def test_a_fault_is_told_from_wear(drives: list[Log], detector: Detector) -> None:
    report = adapt(drives, detector, commissioning=5)
    rows = report["drives"]
    assert [r["log"] for r in rows] == [f"day{i}" for i in range(5, 10)]
    assert [r["alarm"] for r in rows] == [False, False, True, True, True]
    assert "maf_gain" in rows[-1]["faults"]
    assert rows[-1]["faults"]["maf_gain"] == pytest.approx(-0.08, abs=0.02)
    assert not rows[-1]["learned"]
    assert report["budgets"]["restriction"] == {"per_100_drives": 0.2, "total": 0.6, "unit": "1"}
    assert set(rows[0]["wear"]) == {"volumetric_efficiency", "restriction"}
    assert all(isinstance(r["denial"], float) for r in rows)
    json.dumps(report)


def test_healthy_drives_are_quiet(drives: list[Log], detector: Detector) -> None:
    rows = adapt(drives[:6] + drives[:3], detector, commissioning=6)["drives"]
    assert not any(r["alarm"] for r in rows)
    assert all(r["learned"] for r in rows)


def test_without_the_witness_signals_nothing_is_denied(drives: list[Log], detector: Detector) -> None:
    deaf = [
        replace(
            log,
            groups={
                k: replace(
                    g,
                    frame=g.frame.drop("u_Vnt", strict=False),
                    signals={n: s for n, s in g.signals.items() if n != "u_Vnt"},
                )
                for k, g in log.groups.items()
            },
        )
        for log in drives[:6]
    ]
    assert [r["denial"] for r in adapt(deaf, detector, commissioning=5)["drives"]] == [None]


def test_what_cannot_be_followed(drives: list[Log], detector: Detector) -> None:
    with pytest.raises(LogError, match="5 logs with a commissioning of 5: at least 5 are needed"):
        adapt(drives[:5], detector, commissioning=5)
    without = replace(detector, recipe=replace(detector.recipe, wear={}))
    with pytest.raises(RecipeError, match=r"cannot follow wear: it needs .* \[wear.<name>\]"):
        adapt(drives, without)


def test_by_command(
    drives: list[Log], store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [str(write_log(log, tmp_path / f"{log.name}.parquet")) for log in drives[:7]]
    words = [
        "adapt",
        *paths,
        "--recipe",
        "diesel_airpath",
        "--store",
        str(store.folder),
        "--commissioning",
        "6",
    ]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "budget of volumetric_efficiency: 0.05 in 100 drives, 0.15 in all" in said
    assert "day6" in said
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["commissioning"] == 6
    assert main([*words, "--out", str(tmp_path)]) == 2
    assert "is not the folder of a batch" in capsys.readouterr().err
    summary_frame([]).write_parquet(tmp_path / "summary.parquet")
    assert main([*words, "--out", str(tmp_path)]) == 0
    (worn,) = wear_of_batch(tmp_path)
    assert (worn.vehicle, worn.logs) == ("2.2 l diesel van, simulated", ("day6",))
