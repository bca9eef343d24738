from __future__ import annotations

import polars as pl

from pipeline.fleet import fleet_table
from pipeline.summary import summary_frame


def row(
    log: str, vehicle: str | None, fault: str | None, cycle: int | None = None, **more: object
) -> dict[str, object]:
    status = "failed" if fault is None else "ok"
    return {
        "log": log, "status": status, "vehicle": vehicle, "fault": fault, "cycle": cycle, "detector": "d1",
        "recipe": "r", "duration_s": None if fault is None else 1800.0, **more,
    }  # fmt: skip


def test_counts_by_vehicle_and_detector() -> None:
    table = fleet_table(
        summary_frame([
            row("b", "car", "boost_leak", 2, fault_codes="boost_leak:confirmed", mil=True),
            row("a", "car", "boost_leak", 1, fault_codes="boost_leak:pending", mil=False),
            row("c", "car", "maf_gain", 3, fault_codes="boost_leak:confirmed maf_gain:pending", mil=True),
            row("d", "car", None),
            row("e", "van", "none", 1, mil=False, status="salvaged"),
            row("f", "van", "insufficient_evidence", 2, mil=False),
            row("g", "van", "none", 3, detector="d2", mil=False),
            row("h", None, "none"),
            row("i", None, None),
        ])
    )  # fmt: skip
    car, van, van2, nobody = table.to_dicts()
    assert (car["vehicle"], car["logs"], car["failed"], car["faulty"], car["none"]) == ("car", 4, 1, 3, 0)
    assert car["faults"] == "2 boost_leak, 1 maf_gain"
    assert (car["hours"], car["last_log"], car["mil"]) == (1.5, "c", True)
    assert car["fault_codes"] == "boost_leak:confirmed maf_gain:pending"
    assert (van["detector"], van["none"], van["insufficient_evidence"], van["salvaged"]) == ("d1", 1, 1, 1)
    assert (van["faults"], van["mil"], van["last_log"]) == (None, False, "f")
    assert (van2["detector"], van2["logs"]) == ("d2", 1)
    assert (nobody["vehicle"], nobody["logs"], nobody["failed"], nobody["mil"]) == (None, 2, 1, None)
    assert table["logs"].sum() == 9


def test_an_empty_summary_gives_an_empty_table() -> None:
    assert fleet_table(summary_frame([])).height == 0


def test_order_of_rows_does_not_matter() -> None:
    rows = [row(f"{i}", "car", "none", i) for i in range(5)]
    assert fleet_table(summary_frame(rows)).equals(fleet_table(summary_frame(rows[::-1])))
    assert isinstance(fleet_table(summary_frame(rows)), pl.DataFrame)
