from __future__ import annotations

import json
import random
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ingest.errors import LogError
from pipeline.driving_cycles import FORGET, Cycle, Vehicles, after, in_order, lit

NONE, NO_WORD, LEAK, MAF = "none", "insufficient_evidence", "boost_leak", "maf_gain"


def codes_after(*faults: str | tuple[str, ...]) -> dict[str, str]:
    """Statuses after cycles with these faults; of a tuple the first is the verdict, all are in the set."""
    codes: Any = {}
    for i, fault in enumerate(faults):
        named = (fault,) if isinstance(fault, str) else fault
        codes = after(codes, Cycle(log=f"drive{i}", start_time=None, fault=named[0], set=named))
    return {f: c.status for f, c in codes.items()}


@pytest.mark.parametrize(
    ("cycles", "codes"),
    [
        ((NONE, NONE), {}),
        ((LEAK,), {LEAK: "pending"}),
        ((LEAK, LEAK), {LEAK: "confirmed"}),
        ((LEAK, NONE), {}),
        ((LEAK, NONE, LEAK), {LEAK: "pending"}),
        ((LEAK, NO_WORD, LEAK), {LEAK: "confirmed"}),  # says nothing and breaks no row
        ((LEAK, NO_WORD), {LEAK: "pending"}),
        ((LEAK, MAF), {LEAK: "pending", MAF: "pending"}),
        ((LEAK, MAF, LEAK), {LEAK: "pending", MAF: "pending"}),  # not two in a row
        (
            (LEAK, (MAF, LEAK)),
            {LEAK: "confirmed", MAF: "pending"},
        ),  # ... but not told apart
        (((MAF, LEAK),), {MAF: "pending"}),
        ((LEAK, LEAK, NONE, NONE), {LEAK: "confirmed"}),
        ((LEAK, LEAK, NONE, NONE, NONE), {LEAK: "healed"}),
        ((LEAK, LEAK, NONE, NONE, LEAK, NONE, NONE), {LEAK: "confirmed"}),
        ((LEAK, LEAK, NONE, NONE, NO_WORD, NONE), {LEAK: "healed"}),
        ((LEAK, LEAK, NONE, NONE, NONE, LEAK), {LEAK: "pending"}),
        ((LEAK, LEAK, NONE, NONE, NONE, LEAK, LEAK), {LEAK: "confirmed"}),
        ((LEAK, LEAK, *[NONE] * (3 + FORGET - 1)), {LEAK: "healed"}),
        ((LEAK, LEAK, *[NONE] * (3 + FORGET)), {}),
        (("unknown", "unknown"), {"unknown": "confirmed"}),
    ],
)
def test_codes(cycles: tuple[str, ...], codes: dict[str, str]) -> None:
    assert codes_after(*cycles) == codes


@given(st.lists(st.sampled_from([NONE, NO_WORD, LEAK, MAF]), max_size=40))
def test_the_indicator_needs_two_in_a_row_and_three_without(faults: list[str]) -> None:
    told = [f for f in faults if f != NO_WORD]
    codes: Any = {}
    for fault in told:
        codes = after(codes, Cycle(log="x", start_time=None, fault=fault))
    pairs = any(a == b != NONE for a, b in pairwise(told))
    if lit(codes):
        assert pairs
        assert told[-3:] != [NONE] * 3
    elif pairs:
        assert any(told[i : i + 3] == [NONE] * 3 for i in range(len(told)))
    assert codes_after(*faults) == codes_after(*told)


def rows(*faults: str, vehicle: str | None = "car", timed: bool = True) -> list[dict[str, Any]]:
    return [
        {"log": f"{vehicle}{i}", "vehicle": vehicle, "fault": fault, "set": "" if fault == NONE else fault,
         "start_time": f"2026-01-{i + 1:02}T08:00:00+00:00" if timed else None}
        for i, fault in enumerate(faults)
    ]  # fmt: skip


def test_every_log_is_told_what_holds_after_it() -> None:
    told = Vehicles().judge([*rows(LEAK, LEAK, NONE), *rows(MAF, vehicle="van"), *rows(MAF, vehicle=None)])
    assert told == {
        "car0": {"cycle": 1, "fault_codes": "boost_leak:pending", "mil": False},
        "car1": {"cycle": 2, "fault_codes": "boost_leak:confirmed", "mil": True},
        "car2": {"cycle": 3, "fault_codes": "boost_leak:confirmed", "mil": True},
        "van0": {"cycle": 1, "fault_codes": "maf_gain:pending", "mil": False},
    }


@pytest.mark.parametrize("timed", [True, False])
def test_order_of_arrival_and_batches_do_not_matter(timed: bool, tmp_path: Path) -> None:
    drives = rows(LEAK, NONE, LEAK, LEAK, NONE, NONE, NONE, MAF, MAF, NONE, LEAK, LEAK, timed=timed)
    at_once = Vehicles().judge(drives)
    random.Random(1).shuffle(drives)
    told: dict[str, Any] = {}
    for part in (drives[:5], drives[5:6], drives[6:]):  # each batch knows its own logs and the file
        vehicles = Vehicles.load(tmp_path / "vehicles.json")
        told = vehicles.judge(part)
        vehicles.save(tmp_path / "vehicles.json")
    assert told == at_once


def test_a_log_that_is_judged_anew_replaces_what_was_said() -> None:
    vehicles = Vehicles()
    vehicles.judge(rows(LEAK, LEAK))
    told = vehicles.judge(rows(NONE, LEAK))
    assert told["car1"] == {"cycle": 2, "fault_codes": "boost_leak:pending", "mil": False}
    failed = {"log": "car1", "vehicle": "car", "fault": None}
    assert "car1" not in vehicles.judge([failed])


def test_order_is_that_of_time_whatever_its_zone_else_of_numbers_in_names() -> None:
    late, early = (
        Cycle(log="a", start_time="2026-01-01T08:00:00+00:00", fault=NONE),
        Cycle(log="b", start_time="2026-01-01T08:30:00+01:00", fault=NONE),
    )
    assert in_order([late, early]) == [early, late]
    names = ["drive10", "drive9", "drive1"]
    cycles = [Cycle(log=n, start_time=None, fault=NONE) for n in names]
    assert [c.log for c in in_order(cycles)] == ["drive1", "drive9", "drive10"]


def test_the_file_says_it_all(tmp_path: Path) -> None:
    path = tmp_path / "vehicles.json"
    vehicles = Vehicles()
    vehicles.judge(rows(LEAK, LEAK))
    vehicles.save(path)
    kept = json.loads(path.read_text())["vehicles"]["car"]
    assert kept["mil"] is True
    assert kept["codes"]["boost_leak"] == {
        "status": "confirmed", "seen": 2, "clean": 0, "first": "car0", "last": "car1",
    }  # fmt: skip
    assert [c["log"] for c in kept["cycles"]] == ["car0", "car1"]


@pytest.mark.parametrize("content", ["", "[]", '{"format": 9, "vehicles": {}}', '{"format": 1}'])
def test_a_file_that_cannot_be_read_is_not_overwritten(tmp_path: Path, content: str) -> None:
    (tmp_path / "vehicles.json").write_text(content)
    with pytest.raises(LogError, match=r"vehicles\.json.* cannot be read"):
        Vehicles.load(tmp_path / "vehicles.json")
