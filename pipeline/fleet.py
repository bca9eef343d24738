"""The fleet at a glance: a batch's summary by vehicle and detector."""

from __future__ import annotations

import polars as pl

_FAULTY = pl.col("fault").is_not_null() & ~pl.col("fault").is_in(["none", "insufficient_evidence"])


def fleet_table(summary: pl.DataFrame) -> pl.DataFrame:
    """One row per vehicle (null: not known) and detector, in order of their names.

    ``logs`` and of these ``failed``, ``salvaged``, ``none``, ``insufficient_evidence`` and ``faulty``;
    ``faults`` says how often each was named; ``hours`` driven; ``last_log`` is the vehicle's
    last driving cycle, with the fault codes and the malfunction indicator after it.
    """
    counted = (
        summary.filter(_FAULTY)
        .group_by("vehicle", "detector", "fault")
        .len()
        .sort("len", "fault", descending=[True, False])
        .group_by("vehicle", "detector", maintain_order=True)
        .agg(faults=pl.format("{} {}", "len", "fault").str.join(", "))
    )
    known = pl.col("status") != "failed"
    table = (
        summary.sort("cycle", "log")
        .group_by("vehicle", "detector")
        .agg(
            recipe=pl.col("recipe").first(),
            logs=pl.len(),
            failed=(pl.col("status") == "failed").sum(),
            salvaged=(pl.col("status") == "salvaged").sum(),
            none=(pl.col("fault") == "none").sum(),
            insufficient_evidence=(pl.col("fault") == "insufficient_evidence").sum(),
            faulty=_FAULTY.sum(),
            hours=(pl.col("duration_s").sum() / 3600.0).round(3),
            first_start=pl.col("start_time").filter(known).first(),
            last_start=pl.col("start_time").filter(known).last(),
            last_log=pl.col("log").filter(known).last(),
            fault_codes=pl.col("fault_codes").filter(known).last(),
            mil=pl.col("mil").filter(known).last(),
        )
    )
    return table.join(counted, on=["vehicle", "detector"], how="left", nulls_equal=True).sort(
        "vehicle", "detector", nulls_last=True
    )
